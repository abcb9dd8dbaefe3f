"""The interface between servo level and arm, the simulated arm, and injected faults."""

from rack.levels import compiled
from rack.levels.arm import drives, sensors, substeps
from rack.levels.arm.arm import Arm, find_arm
from rack.levels.arm.link import DriveState, JointTarget, Sensed
from rack.levels.arm.simulated import SimulatedArm
from rack.levels.robot import dynamics

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
