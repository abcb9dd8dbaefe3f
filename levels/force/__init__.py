"""Control of contact forces: the wrist sensor's wrench, hybrid motion/force control, and a server of both.

Names are imported on first use: tools that read the messages need not wait for the levels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.exports import on_first_use

if TYPE_CHECKING:
    from rack.levels.force.arm_executor import ForceArmExecutor
    from rack.levels.force.client import ForceClient
    from rack.levels.force.hybrid import HybridExecutor
    from rack.levels.force.server import ForceServer

__all__ = ["ForceArmExecutor", "ForceClient", "ForceServer", "HybridExecutor"]
_PLACES = {
    "rack.levels.force.arm_executor": ("ForceArmExecutor",),
    "rack.levels.force.client": ("ForceClient",),
    "rack.levels.force.hybrid": ("HybridExecutor",),
    "rack.levels.force.server": ("ForceServer",),
}

if not TYPE_CHECKING:  # a type checker would take every misspelt name for one of these
    __getattr__ = on_first_use(__name__, _PLACES)
