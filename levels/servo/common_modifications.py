"""Control modifications for any arm: a dead zone before the law, PD control in its place, a notch
after it.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from rack.levels.algebra import Array
from rack.levels.errors import LevelError
from rack.levels.servo.modification import Hook, LawContext, LawSample, Modification
from rack.levels.tables import Positive, Table, read_params


class DeadZoneParams(Table):
    """Parameters of `DeadZone`."""

    width: Positive
    """position error up to which a joint counts as at its set point [rad]"""


class DeadZone(Modification):
    """Hides small position errors from the law, and reduces larger ones by as much: sticking joints
    do not hunt.
    """

    hook = Hook.BEFORE
    params = DeadZoneParams

    def __init__(self, context: LawContext) -> None:
        super().__init__(context)
        self._width = read_params(DeadZoneParams, context.params).width

    def modify(self, sample: LawSample) -> None:
        """Move the position seen towards the one wanted."""
        error = sample.wanted_position - sample.position
        sample.position += np.minimum(np.maximum(error, -self._width), self._width)


class JointPdParams(Table):
    """Parameters of `JointPd`."""

    bandwidth: Positive = Field(40.0, le=400.0)
    """natural frequency of the error in every joint [rad/s]"""
    damping: Positive = Field(1.0, le=3.0)
    """damping ratio of the error"""
    load: bool = True
    """add the torque of gravity and motion; without it joints sag under their load"""


class JointPd(Modification):
    """Controls every joint by itself: PD on its error, without acceleration, coupling or
    friction.
    """

    hook = Hook.INSTEAD
    params = JointPdParams

    def __init__(self, context: LawContext) -> None:
        super().__init__(context)
        params = read_params(JointPdParams, context.params)
        self._stiffness = params.bandwidth**2
        self._damping = 2.0 * params.damping * params.bandwidth
        self._load = float(params.load)

    def modify(self, sample: LawSample) -> None:
        """Set the torque."""
        error = sample.wanted_position - sample.position
        slip = sample.wanted_velocity - sample.velocity
        pull = sample.inertia * (self._stiffness * error + self._damping * slip)
        sample.torque = pull + self._load * sample.load


class NotchParams(Table):
    """Parameters of `Notch`."""

    frequency: Positive
    """frequency that is removed from the torque [Hz]; below half the law's rate"""
    quality: Positive = Field(1.0, le=100.0)
    """frequency over the width of the notch"""


class Notch(Modification):
    """Removes one frequency from the torque, such as a resonance of a drive or a link."""

    hook = Hook.AFTER
    params = NotchParams

    def __init__(self, context: LawContext) -> None:
        """Raise `LevelError` for a frequency that is not below half the law's rate."""
        super().__init__(context)
        params = read_params(NotchParams, context.params)
        half_hz = 0.5 / context.period_s
        if params.frequency >= half_hz:
            raise LevelError(
                f"params.frequency = {params.frequency:g} Hz: permitted: below half the law's rate,"
                f" {half_hz:g} Hz"
            )
        angle = 2.0 * math.pi * params.frequency * context.period_s
        cosine = math.cos(angle)
        alpha = math.sin(angle) / (2.0 * params.quality)
        self._feed = np.array([1.0, -2.0 * cosine, 1.0]) / (1.0 + alpha)
        self._back = np.array([-2.0 * cosine, 1.0 - alpha]) / (1.0 + alpha)
        self._given: Array = np.zeros(
            (2, len(context.joints))
        )  # N m: the last two torques of the law, newest first
        self._made: Array = np.zeros(
            (2, len(context.joints))
        )  # N m: likewise, without the frequency

    def begin(self, sample: LawSample) -> None:
        """Start as if the torque had always been the present one."""
        self._given[:] = self._made[:] = sample.torque

    def modify(self, sample: LawSample) -> None:
        """Filter the torque."""
        now, one, two = self._feed
        back_one, back_two = self._back
        made = now * sample.torque + one * self._given[0] + two * self._given[1]
        made -= back_one * self._made[0] + back_two * self._made[1]
        self._given[1] = self._given[0]
        self._made[1] = self._made[0]
        self._given[0] = sample.torque
        self._made[0] = made
        sample.torque = made
