"""The arm behind one small interface, the simulated one, and what may go wrong on the way to it."""

from rack.levels.arm.arm import Arm, Link, Sensed
from rack.levels.arm.faulty import FaultyLink
from rack.levels.arm.simulated import SimulatedArm

__all__ = ["Arm", "FaultyLink", "Link", "Sensed", "SimulatedArm"]
