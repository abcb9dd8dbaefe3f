"""Whether the servo follows the set points: only then is there motion to go on with."""

from __future__ import annotations

import numpy as np

from levels.level import Reading

MISSED_STATUSES = 3
"""Cycles in a row without a new status after which the servo is silent."""
HANDOVER_CYCLES = 4
"""Cycles from the first set point until a status must show that the servo follows it."""
REST_RAD_S = 1e-3
"""A joint whose interpolated set point is slower than this rests."""


class Tracking:
    """Tells from the servo's status whether it is in step with this level.

    The two fall out of step when one of them starts anew or misses so many cycles that the servo holds by itself.
    They come in step where the servo holds the arm at rest, and motion goes on from there.
    """

    def __init__(self) -> None:
        self.in_step = False
        self.silent_cycles = 0
        self._cycles_in_step = 0

    def update(self, status: Reading) -> bool:
        """Take in one status; True in the cycle in which servo and level come in step."""
        self.silent_cycles = 0 if status.is_new else self.silent_cycles + 1
        self._cycles_in_step += 1
        servo = status.value
        left_alone = bool(servo.holding) and self._cycles_in_step > HANDOVER_CYCLES
        if self.silent_cycles > MISSED_STATUSES or left_alone:
            self.in_step = False
        if self.in_step or not status.is_new or not servo.holding:
            return False
        if np.abs(servo.target_velocity).max() > REST_RAD_S:
            return False
        self.in_step, self._cycles_in_step = True, 0
        return True


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
