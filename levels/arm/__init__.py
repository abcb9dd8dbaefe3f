"""The arm: its interface to the servo level, the simulated one, and the faults injected between the
two."""

from rack.levels import compiled
from rack.levels.arm import drives, poses, substeps
from rack.levels.arm.arm import Arm, CalibratedLink, DriveState, JointTarget, Link, Sensed, find_arm
from rack.levels.arm.faulty import FaultyLink
from rack.levels.arm.guard import GuardedArm
from rack.levels.arm.present import PresentLink
from rack.levels.arm.simulated import SimulatedArm
from rack.levels.robot import dynamics

__all__ = [
    "Arm",
    "CalibratedLink",
    "DriveState",
    "FaultyLink",
    "GuardedArm",
    "JointTarget",
    "Link",
    "PresentLink",
    "Sensed",
    "SimulatedArm",
    "find_arm",
    "preload",
]


def preload() -> None:
    """Load the compiled functions of an arm, for any robot: see `Executor.preload`."""
    compiled.preload(dynamics, substeps, drives, poses)
