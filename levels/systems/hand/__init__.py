"""A hand with tendon-driven fingers: its plant, and its loops from tendon tension to grasp."""

from rack.levels.systems.hand.events import EventfulFingertipLoop, EventServer
from rack.levels.systems.hand.executor import HandExecutor
from rack.levels.systems.hand.grasp import GraspExecutor
from rack.levels.systems.hand.loop_boards import (
    FingerExecutor,
    FingertipLoop,
    JointLoop,
    TendonLoop,
)

__all__ = [
    "EventServer",
    "EventfulFingertipLoop",
    "FingerExecutor",
    "FingertipLoop",
    "GraspExecutor",
    "HandExecutor",
    "JointLoop",
    "TendonLoop",
]
