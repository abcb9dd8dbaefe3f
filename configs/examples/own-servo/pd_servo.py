"""A servo law of one's own: PD control with gravity compensation, in place of computed torque."""

from __future__ import annotations

from rack.levels.algebra import Array
from rack.levels.servo import LawParams, Motion, SensedMotion, ServoLaw
from rack.levels.tables import Positive


class Gains(LawParams):
    """What `[board.servo.params]` may hold, besides what any servo law has."""

    stiffness: Positive = 1600.0
    """acceleration for an error of one rad, 1/s2"""
    damping: Positive = 80.0
    """acceleration against an error of one rad/s [1/s]"""


class PdServo(ServoLaw):
    """Drives every joint by itself; gains are scaled by the inertia of each joint."""

    params = Gains
    settings: Gains

    def torques(self, set_point: Motion, sensed: SensedMotion) -> Array:
        """Return the torques, (joints,), N m."""
        gains = self.settings
        error = set_point.position - sensed.position
        slip = set_point.velocity - sensed.velocity
        inertia, load = self.terms
        return inertia.diagonal() * (gains.stiffness * error + gains.damping * slip) + load
