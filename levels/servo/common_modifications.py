"""Control modifications for any arm.

`DeadZone` acts before the law, `JointPd` in place of it, and `Notch` after it.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from rack.levels.errors import LevelError
from rack.levels.servo.modification import Hook, LawContext, LawSample, Modification
from rack.levels.tables import Positive, Table, read_params


class DeadZoneParams(Table):
    """Parameters of `DeadZone`."""

    width: Positive
    """position error up to which a joint counts as at its set point [rad]"""


class DeadZone(Modification):
    """Hides small position errors from the law, and reduces larger ones by the same amount.

    This keeps joints with friction from hunting around the set point.
    """

    hook = Hook.BEFORE
    params = DeadZoneParams

    def __init__(self, context: LawContext) -> None:
        super().__init__(context)
        self._width = read_params(DeadZoneParams, context.params).width

    def modify(self, sample: LawSample) -> None:
        """Move the position that the law uses towards the wanted one, by at most the width."""
        error = sample.wanted_position - sample.position
        sample.position += np.clip(error, -self._width, self._width)


class JointPdParams(Table):
    """Parameters of `JointPd`."""

    bandwidth: Positive = Field(40.0, le=400.0)
    """natural frequency of the error in every joint [rad/s]"""
    damping: Positive = Field(1.0, le=3.0)
    """damping ratio of the error"""
    load: bool = True
    """add the torque of gravity and motion; without it joints sag under their load"""


class JointPd(Modification):
    """Controls each joint separately by proportional-derivative (PD) control.

    It ignores the wanted acceleration, friction, and the coupling between joints.
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
        """Set the torques by PD control, scaled by the inertia of each joint."""
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
        """Raise `LevelError` for a frequency that is not below half the rate of the law."""
        super().__init__(context)
        params = read_params(NotchParams, context.params)
        half_hz = 0.5 / context.period_s
        if params.frequency >= half_hz:
            raise LevelError(
                f"params.frequency = {params.frequency:g} Hz: must be below half the law's rate,"
                f" {half_hz:g} Hz"
            )
        angle = 2.0 * math.pi * params.frequency * context.period_s
        cosine = math.cos(angle)
        alpha = math.sin(angle) / (2.0 * params.quality)
        self._feed = np.array([1.0, -2.0 * cosine, 1.0]) / (1.0 + alpha)
        self._back = np.array([-2.0 * cosine, 1.0 - alpha]) / (1.0 + alpha)
        # (2, joints), N m: the last two torques of the law and of the filter, newest first.
        self._unfiltered, self._filtered = np.zeros((2, 2, len(context.joints)))

    def begin(self, sample: LawSample) -> None:
        """Initialise the filter as if the torque had been constant so far."""
        self._unfiltered[:] = self._filtered[:] = sample.torque

    def modify(self, sample: LawSample) -> None:
        """Pass the torque through the filter."""
        now, one, two = self._feed
        back_one, back_two = self._back
        newer, older = self._unfiltered
        torque = now * sample.torque + one * newer + two * older
        torque -= back_one * self._filtered[0] + back_two * self._filtered[1]
        for history, value in ((self._unfiltered, sample.torque), (self._filtered, torque)):
            history[1] = history[0]
            history[0] = value
        sample.torque = torque
