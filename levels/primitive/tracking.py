"""Whether the servo receives and follows set points: motion continues only while it does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rack.backplane.message import State
from rack.levels.level import Reading
from rack.levels.messages import DrivenArm, Error
from rack.levels.primitive.motion_segment import SegmentFault

LEAD_CYCLES = 2
"""Cycles from the release that makes a set point to the tick at which it is due.

One cycle of logical execution time brings it to the servo, which then interpolates to it over a
second one."""
SEEN_CYCLES = 2
"""Cycles by which the world model lags the servo."""
HANDOVER_CYCLES = 4
"""Cycles from the first set point until the servo's status must show that it follows."""
MAX_MISSED_STATUSES = 3
"""Consecutive cycles without a new status after which the servo is silent."""
MAX_REST_RAD_S = 1e-3
"""A joint whose interpolated set point is slower than this rests."""
MAX_UNEXPLAINED_CYCLES = 50
"""A longer wait is reported with its reason; shorter ones are normal after a restart."""


class Tracking:
    """Decides from the servo's status whether it is in step with this level.

    They fall out of step when either restarts, or misses so many cycles that the servo holds by
    itself. They get back into step when the servo holds the arm at rest and is not stopped; motion
    continues from there.
    """

    def __init__(self) -> None:
        self.in_step = False
        self.silent_cycles = 0  # consecutive cycles without a new status
        self._cycles_in_step = 0
        self._unexplained_cycles = 0

    def update(self, status: Reading[DrivenArm]) -> bool:
        """Process one status; True in the cycle in which servo and level get into step."""
        heard = status.is_new and not status.is_lost
        self.silent_cycles = 0 if heard else self.silent_cycles + 1
        self._cycles_in_step += 1
        servo = status.message
        left_alone = servo.holding and self._cycles_in_step > HANDOVER_CYCLES
        if self.silent_cycles > MAX_MISSED_STATUSES or left_alone or servo.stopped:
            self.in_step = False
        self._unexplained_cycles = (
            0 if self.in_step or servo.stopped else self._unexplained_cycles + 1
        )
        if self.in_step or not heard or not servo.holding or servo.stopped:
            return False
        # Written so that NaN does not count as rest.
        if (
            not np.abs(servo.target_velocity).max() <= MAX_REST_RAD_S
            or not np.isfinite(servo.target).all()
        ):
            return False
        self.in_step = True
        self._cycles_in_step = 0
        return True

    def awaited(self, servo: DrivenArm) -> str:
        """Return what a level out of step waits for."""
        if self.silent_cycles > MAX_MISSED_STATUSES:
            return f"waiting for servo: no status for {self.silent_cycles} cycles"
        if servo.state == State.HOLDING and servo.reason:
            return f"waiting for servo: {servo.reason}"
        if servo.standing:
            return "waiting for servo: held by the operator until `resume`"
        if servo.braked:
            return "waiting for servo: brakes engaged"
        if self._unexplained_cycles > MAX_UNEXPLAINED_CYCLES:
            return "waiting for servo: it does not report `holding` with a target at rest"
        return "waiting for servo: it does not follow set points"


class Straying:
    """Counts cycles in which the arm is off its set point: a few are permitted, and motion holds
    meanwhile.
    """

    def __init__(self, joints: Sequence[str], permitted_rad: float, permitted_cycles: int) -> None:
        self._joints = joints
        self._permitted_rad = permitted_rad
        self._permitted_cycles = permitted_cycles
        self._cycles = 0
        self.place = ""  # the joint and its distance, readable; empty: none is off
        self.fault: SegmentFault | None = None

    @property
    def strays(self) -> bool:
        """True while a joint is too far from its set point."""
        return self._cycles > 0

    def forget(self) -> None:
        """Start counting anew."""
        self._cycles = 0
        self.place = ""
        self.fault = None

    def update(self, servo: DrivenArm) -> None:
        """Process one status; set `fault` when a joint has been too far away for too long."""
        away = np.abs(servo.position - servo.target)
        if away.max() <= self._permitted_rad:
            self.forget()
            return
        self._cycles += 1
        joint = int(away.argmax())
        self.place = f"joint '{self._joints[joint]}' is {away[joint]:.4f} rad from its set point"
        if self._cycles > self._permitted_cycles:
            self.fault = SegmentFault(
                Error.FOLLOWING, f"{self.place}; valid: at most {self._permitted_rad} rad"
            )
