"""A servo law in place of computed torque: PD control with gravity compensation."""

from __future__ import annotations

from rack.levels.algebra import Array
from rack.levels.servo import LawParams, Motion, SensedMotion, ServoLaw
from rack.levels.tables import Positive


class Gains(LawParams):
    """Additional keys of `[board.servo.params]`."""

    stiffness: Positive = 1600.0
    """acceleration for an error of one rad, 1/s2"""
    damping: Positive = 80.0
    """acceleration against an error of one rad/s [1/s]"""


class PdServo(ServoLaw):
    """Controls every joint independently. Gains are scaled by the inertia of each joint."""

    params = Gains
    settings: Gains

    def torques(self, set_point: Motion, sensed: SensedMotion) -> Array:
        """Return the torques, (joints,), in N m."""
        gains = self.settings
        error = set_point.position - sensed.position
        slip = set_point.velocity - sensed.velocity
        inertia, load = self.terms
        return inertia.diagonal() * (gains.stiffness * error + gains.damping * slip) + load
