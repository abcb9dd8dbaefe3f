"""Control of contact forces: the wrist sensor, hybrid motion/force control, and a server."""

from rack.levels.systems.force.arm_executor import ForceArmExecutor
from rack.levels.systems.force.client import ForceClient
from rack.levels.systems.force.hybrid import HybridExecutor
from rack.levels.systems.force.network_server import NetworkServer
from rack.levels.systems.force.server import ForceServer

__all__ = ["ForceArmExecutor", "ForceClient", "ForceServer", "HybridExecutor", "NetworkServer"]
