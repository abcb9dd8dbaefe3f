"""The interface between servo level and arm, the simulated arm, and injected faults."""

from rack.levels import compiled
from rack.levels.arm import drives, sensors, substeps
from rack.levels.arm.arm import Arm
from rack.levels.arm.link import DriveState, JointTarget, Sensed
from rack.levels.arm.simulated import SimulatedArm
from rack.levels.robot import dynamics
from rack.levels.tables import validate_class

__all__ = [
    "Arm",
    "DriveState",
    "JointTarget",
    "Sensed",
    "SimulatedArm",
    "find_arm",
    "preload",
]


def preload() -> None:
    """Load the compiled functions that any arm needs; see `Executor.preload`."""
    compiled.preload(dynamics, substeps, drives, sensors)


def find_arm(reference: str) -> type[Arm]:
    """Return the class of an arm, given a reference "package.module:Class".

    Raises:
        ValueError: The class is missing, abstract, or not the class of an arm.
    """
    return validate_class(reference, Arm)
