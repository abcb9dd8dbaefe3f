"""What an operator has the servo level do: hold, or bring the joints to a set point; and then back the way it came."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rack.backplane.mailbox.mailbox import Reading
from rack.backplane.message import Message
from rack.levels.operator import Commands, What
from rack.levels.orders import Orders, joints_of
from rack.levels.servo.curves import Motion
from rack.levels.servo.reference import Reference

Array = NDArray[np.float64]


class Standing:
    """Follows the operator. `stands`: the level follows the operator, and not the level above.

    To resume, the arm goes back by the places from which it set out: the level above finds it on its path, and what
    was free on the way out is free on the way back. A restarted board does not know the way: there the level above
    goes on from where the arm is.
    """

    def __init__(self, commands: Commands, joints: Sequence[str], ranges: Array) -> None:
        """Permit set points within `ranges` (joints, 2), rad."""
        self.orders = Orders(commands)
        self.stands = False
        self._joints, self._ranges = joints, ranges
        self._goal: Array | None = None
        self._way: list[Array] = []

    def take(self, operator: Reading) -> None:
        """Take up what is new."""
        if not self.orders.take(operator, self._judge):
            return
        if self.orders.standing is What.NONE and self._way:
            self.orders.under_way()
        self.stands = self.orders.standing is not What.NONE or bool(self._way)

    @property
    def reason(self) -> str:
        """Say for whom the arm does not follow the level above; empty: it does."""
        if not self.stands:
            return ""
        if self.orders.standing is What.NONE:
            return "goes back to where the operator took over, then follows the level above"
        what = "held" if self.orders.standing is What.HOLD else f"at the {self.orders.standing.name.lower()}"
        return f"{what} by the operator; `resume` goes on"

    def _judge(self, command: Message) -> None:
        """Take the goal of a set point, or refuse it."""
        if self.orders.standing is What.SETPOINT:
            try:
                self._goal = joints_of(command, self._joints, self._ranges)
            except ValueError as error:
                self.orders.refuse(str(error))

    def wanted(self, reference: Reference, tick: int) -> Motion:
        """Return the motion wanted at `tick`, while the level follows the operator."""
        goal = self._aim()
        if goal is None:
            motion = reference.rest(tick)
        else:
            before, motion = reference.goal, reference.to(goal, tick)
            if reference.goal is not before and self.orders.standing is What.SETPOINT:
                self._way.append(motion.position.copy())
        if not motion.velocity.any() and (goal is None or np.array_equal(motion.position, goal)):
            self._arrive()
        return motion

    def _aim(self) -> Array | None:
        """Return where the joints are to go; None: nowhere."""
        if self.orders.standing is What.SETPOINT:
            return self._goal
        return self._way[-1] if self.orders.standing is What.NONE and self._way else None

    def _arrive(self) -> None:
        """Take in that the arm rests where it should."""
        if self.orders.standing is What.NONE and self._way:
            self._way.pop()
        if self.orders.standing is not What.NONE or not self._way:
            self.stands = self.orders.standing is not What.NONE
            self.orders.done()
