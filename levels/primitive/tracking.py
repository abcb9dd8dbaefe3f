"""Whether the servo follows the set points: only then is there motion to go on with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rack.backplane.message import Message, State
from rack.levels.level import Reading
from rack.levels.messages import Error
from rack.levels.primitive.fault import Fault

MISSED_STATUSES = 3
"""Cycles in a row without a new status after which the servo is silent."""
HANDOVER_CYCLES = 4
"""Cycles from the first set point until a status must show that the servo follows it."""
REST_RAD_S = 1e-3
"""A joint whose interpolated set point is slower than this rests."""


class Tracking:
    """Tells from the servo's status whether it is in step with this level.

    The two fall out of step when one of them starts anew or misses so many cycles that the servo holds by itself.
    They come in step where the servo holds the arm at rest and is not stopped, and motion goes on from there.
    """

    def __init__(self) -> None:
        self.in_step = False
        self.silent_cycles = 0
        self._cycles_in_step = 0

    def update(self, status: Reading) -> bool:
        """Take in one status; True in the cycle in which servo and level come in step."""
        heard = status.is_new and not status.is_lost
        self.silent_cycles = 0 if heard else self.silent_cycles + 1
        self._cycles_in_step += 1
        servo = status.value
        left_alone = bool(servo.holding) and self._cycles_in_step > HANDOVER_CYCLES
        if self.silent_cycles > MISSED_STATUSES or left_alone or servo.stopped:
            self.in_step = False
        if self.in_step or not heard or not servo.holding or servo.stopped:
            return False
        # Written so that what is no number does not rest.
        if not np.abs(servo.target_velocity).max() <= REST_RAD_S or not np.isfinite(servo.target).all():
            return False
        self.in_step, self._cycles_in_step = True, 0
        return True


def awaited(servo: Message, silent_cycles: int) -> str:
    """Say what is awaited of a servo level that is out of step."""
    if silent_cycles > MISSED_STATUSES:
        return f"waiting for servo: no status for {silent_cycles} cycles"
    if servo.state == State.HOLDING and servo.reason:
        return f"waiting for servo: {servo.reason}"
    if servo.standing:
        return "waiting for servo: held by the operator until `resume`"
    return f"waiting for servo: {'brakes engaged' if servo.braked else 'it does not follow set points'}"


class Straying:
    """Counts cycles in which the arm is not where the servo wants it: a few may be, and motion holds meanwhile."""

    def __init__(self, joints: Sequence[str], permitted_rad: float, permitted_cycles: int) -> None:
        self._joints = joints
        self._permitted_rad = permitted_rad
        self._permitted_cycles = permitted_cycles
        self._cycles = 0
        self.place = ""  # which joint is how far away; empty: none is
        self.fault: Fault | None = None

    @property
    def strays(self) -> bool:
        """True while a joint is too far from its set point."""
        return self._cycles > 0

    def forget(self) -> None:
        """Begin to count anew."""
        self._cycles, self.place, self.fault = 0, "", None

    def update(self, servo: Message) -> None:
        """Take in one status; `fault` is set when a joint has been too far away for too long."""
        away = np.abs(servo.position - servo.target)
        if away.max() <= self._permitted_rad:
            self.forget()
            return
        self._cycles += 1
        joint = int(away.argmax())
        self.place = f"joint '{self._joints[joint]}' is {away[joint]:.4f} rad from its set point"
        if self._cycles > self._permitted_cycles:
            self.fault = Fault(Error.FOLLOWING, f"{self.place}; at most {self._permitted_rad} is valid")


class Quiet:
    """Counts cycles: enough quiet ones in a row mean settled, too many altogether mean that it never will."""

    def __init__(self, wanted_cycles: int, most_cycles: int) -> None:
        self._wanted_cycles = wanted_cycles
        self._most_cycles = most_cycles
        self._quiet = 0
        self._cycles = 0

    def settled(self, quiet: bool) -> bool:
        """Take in one cycle; say whether it has settled."""
        self._cycles += 1
        self._quiet = self._quiet + 1 if quiet else 0
        return self._quiet >= self._wanted_cycles

    @property
    def overdue(self) -> bool:
        """True when it should have settled long ago."""
        return self._cycles > self._most_cycles
