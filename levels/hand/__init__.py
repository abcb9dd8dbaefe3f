"""A hand of fingers driven by pairs of tendons: its plant, and its loops from tendon tension to grasp."""

from rack.levels.hand.executor import HandExecutor
from rack.levels.hand.finger import FingerExecutor
from rack.levels.hand.fingertip_loop import FingertipLoop
from rack.levels.hand.grasp import GraspExecutor
from rack.levels.hand.joint_loop import JointLoop
from rack.levels.hand.tendon_loop import TendonLoop

__all__ = ["FingerExecutor", "FingertipLoop", "GraspExecutor", "HandExecutor", "JointLoop", "TendonLoop"]
