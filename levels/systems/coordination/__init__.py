"""Task levels of several racks that work together: a coordinator and arms that take its orders."""

from rack.levels.systems.coordination.coordinator import Coordinator
from rack.levels.systems.coordination.ordered_task import OrderedTaskExecutor, OrderedTaskPlanner
from rack.levels.systems.coordination.sharing_executor import SharingServoExecutor

__all__ = [
    "Coordinator",
    "OrderedTaskExecutor",
    "OrderedTaskPlanner",
    "SharingServoExecutor",
]
