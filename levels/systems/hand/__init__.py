"""A hand of fingers driven by pairs of tendons: its plant, and its loops from tendon tension to
grasp.

Names are imported on first use: tools that read the messages need not wait for the levels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.exports import on_first_use

if TYPE_CHECKING:
    from rack.levels.systems.hand.executor import HandExecutor
    from rack.levels.systems.hand.grasp import GraspExecutor
    from rack.levels.systems.hand.loop_boards import (
        FingerExecutor,
        FingertipLoop,
        JointLoop,
        TendonLoop,
    )

__all__ = [
    "FingerExecutor",
    "FingertipLoop",
    "GraspExecutor",
    "HandExecutor",
    "JointLoop",
    "TendonLoop",
]
_PLACES = {
    "rack.levels.systems.hand.executor": ("HandExecutor",),
    "rack.levels.systems.hand.grasp": ("GraspExecutor",),
    "rack.levels.systems.hand.loop_boards": (
        "FingerExecutor",
        "FingertipLoop",
        "JointLoop",
        "TendonLoop",
    ),
}

if not TYPE_CHECKING:  # a type checker would take every misspelt name for one of these
    __getattr__ = on_first_use(__name__, _PLACES)
