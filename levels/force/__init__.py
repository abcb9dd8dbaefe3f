"""Control of contact forces: the wrist sensor's wrench, hybrid motion/force control, and a server of both."""

from rack.levels.force.arm_executor import ForceArmExecutor
from rack.levels.force.client import ForceClient
from rack.levels.force.hybrid import HybridExecutor
from rack.levels.force.server import ForceServer

__all__ = ["ForceArmExecutor", "ForceClient", "ForceServer", "HybridExecutor"]
