"""The arm: its interface to the servo level, the simulated one, and the faults injected between the two."""

from rack.levels.arm.arm import Arm, Link, Sensed, find_arm
from rack.levels.arm.faulty import FaultyLink
from rack.levels.arm.simulated import SimulatedArm

__all__ = ["Arm", "FaultyLink", "Link", "Sensed", "SimulatedArm", "find_arm"]
