"""An operator's commands to the servo level: hold, move the joints, and return the same way."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rack.backplane.mailbox.mailbox import Reading
from rack.levels.algebra import Array, Mask
from rack.levels.operator import (
    PASSING_OPERATIONS,
    Operation,
    OperatorCommand,
    Orders,
    read_joint_goal,
)
from rack.levels.servo.curves import Motion
from rack.levels.servo.reference import Reference


class OperatorControl:
    """Follows the commands of the operator.

    An operator's HOLD or SETPOINT remains in force until RESUME. To resume, the arm returns through
    the positions from which the operator moved it. There were no obstacles between them, and the
    last one is on the path of the level above. A restarted board has lost these positions; the
    level above then continues from the present position of the arm.

    Attributes:
        orders: Commands of the operator and the answers to them.
        is_in_control: True if the level follows the operator instead of the level above.
        return_path: Positions at which the operator took the arm over, (joints,) each, rad, oldest
            first. The arm returns through them. If empty, it continues from where it is.
    """

    def __init__(
        self,
        orders: Orders,
        joints: Sequence[str],
        ranges: Array,
        driven: Mask | None = None,
        *,
        obey: Callable[[OperatorCommand], str],
    ) -> None:
        """Permit set points of some joints.

        Args:
            orders: Operator's commands to the level.
            joints: Names of all joints.
            ranges: Permitted positions, (joints, 2), rad.
            driven: Joints that the operator may move, (joints,). None permits all.
            obey: Carries out a setting or a command to the drives. Returns why it is refused, or an
                empty text.
        """
        self.orders = orders
        self.is_in_control = False
        self._driven = np.full(len(joints), True) if driven is None else driven
        self._joints = [name for name, drives in zip(joints, self._driven, strict=True) if drives]
        self._ranges = ranges[self._driven]
        self._obey = obey
        # (joints,), rad: position of the arm at the newest command.
        self._position = np.zeros(len(joints))
        self._goal: Array | None = None  # (joints,), rad
        self.return_path: list[Array] = []

    def take_commands(self, operator: Reading[OperatorCommand], position: Array) -> None:
        """Accept the operator's new commands.

        Args:
            operator: Newest command and its verdict.
            position: Position of the arm, (joints,), rad.
        """
        self._position[:] = position
        if not self.orders.take_commands(operator, self._process_command):
            return
        if not self.orders.is_in_force and self.return_path:
            self.orders.report_under_way()
        self.is_in_control = self.orders.is_in_force or bool(self.return_path)

    @property
    def reason(self) -> str:
        """Why the arm does not follow the level above. Empty if it does."""
        if not self.is_in_control:
            return ""
        if not self.orders.is_in_force:
            return "returning to where the operator took over, then follows the level above"
        state = "held" if self.orders.is_holding else f"at the {self.orders.standing.name.lower()}"
        return f"{state} by the operator; `resume` releases it"

    def _process_command(self, command: OperatorCommand) -> None:
        """Accept or refuse the goal of a SETPOINT, a setting or a command to the drives."""
        if command.what in PASSING_OPERATIONS:
            if refusal := self._obey(command):
                self.orders.refuse_newest(refusal)
        elif self.orders.standing is Operation.SETPOINT:
            try:
                positions = read_joint_goal(command, self._joints, self._ranges)
            except ValueError as error:
                self.orders.refuse_newest(str(error))
            else:
                self._goal = self._position.copy()
                self._goal[self._driven] = positions

    def compute_motion(self, reference: Reference, tick: int) -> Motion:
        """Return the motion wanted at `tick`, from the operator or, else, from the set points."""
        if not self.is_in_control:
            return reference.compute_motion(tick)
        returns = self.return_path and not self.orders.is_in_force
        goal = self.return_path[-1] if returns else None
        if self.orders.standing is Operation.SETPOINT:
            goal = self._goal
        if goal is None:
            motion = reference.ramp_to_rest(tick)
        else:
            before = reference.goal
            motion = reference.move_to(goal, tick)
            if reference.goal is not before and self.orders.standing is Operation.SETPOINT:
                self.return_path.append(motion.position.copy())
        if not motion.velocity.any() and (goal is None or np.array_equal(motion.position, goal)):
            # The motion has arrived at its goal.
            if returns:
                self.return_path.pop()
            if self.orders.is_in_force or not self.return_path:
                self.is_in_control = self.orders.is_in_force
                self.orders.report_done()
        return motion
