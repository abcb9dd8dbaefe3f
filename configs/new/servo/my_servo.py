"""A servo law to start from: one method. The rest of the servo level is inherited.

`rack.levels.servo.ServoLaw` documents what that is.
"""

from __future__ import annotations

from rack.levels import Live, Positive
from rack.levels.algebra import Array
from rack.levels.servo import LawParams, Motion, SensedMotion, ServoLaw


class MyServoParams(LawParams):
    """Additional keys of `[board.servo.params]`."""

    stiffness: Live[Positive] = 2500.0
    """acceleration for an error of one rad, 1/s2"""
    damping: Live[Positive] = 100.0
    """acceleration against an error of one rad/s [1/s]"""


class MyServo(ServoLaw):
    """Controls every joint independently: PD control with gravity compensation."""

    params = MyServoParams
    settings: MyServoParams

    def torques(self, set_point: Motion, sensed: SensedMotion) -> Array:
        """Return the torques, (joints,), in N m."""
        gains = self.settings
        error = set_point.position - sensed.position
        slip = set_point.velocity - sensed.velocity
        inertia, bias = self.terms
        wanted = gains.stiffness * error + gains.damping * slip  # rad/s2
        torque: Array = inertia.diagonal() * wanted + bias
        return torque
