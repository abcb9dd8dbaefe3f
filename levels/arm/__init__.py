"""The arm behind one small interface, and the simulated one."""

from levels.arm.arm import Arm, Sensed
from levels.arm.simulated import SimulatedArm

__all__ = ["Arm", "Sensed", "SimulatedArm"]
