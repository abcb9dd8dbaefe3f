"""Control of contact forces: the wrist sensor's wrench, hybrid motion/force control, and a server
of both.

Names are imported on first use: tools that read the messages need not wait for the levels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.exports import on_first_use

if TYPE_CHECKING:
    from rack.levels.systems.force.arm_executor import ForceArmExecutor
    from rack.levels.systems.force.client import ForceClient
    from rack.levels.systems.force.hybrid import HybridExecutor
    from rack.levels.systems.force.server import ForceServer

__all__ = ["ForceArmExecutor", "ForceClient", "ForceServer", "HybridExecutor"]
_PLACES = {
    "rack.levels.systems.force.arm_executor": ("ForceArmExecutor",),
    "rack.levels.systems.force.client": ("ForceClient",),
    "rack.levels.systems.force.hybrid": ("HybridExecutor",),
    "rack.levels.systems.force.server": ("ForceServer",),
}

if not TYPE_CHECKING:  # a type checker would take every misspelt name for one of these
    __getattr__ = on_first_use(__name__, _PLACES)
