"""An operator's goto at the task level: one move in place of the program's, and then the rest of the program.

It leaves the program in a free motion, or right behind one, which is done again from wherever the arm has been. What is
done with an object is done to its end first: approach, grasp, depart.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message, State
from rack.levels.messages import Verb
from rack.levels.operator import Answer, Goal, Operation, Orders, described, joints_of
from rack.levels.planning.move import Move
from rack.levels.planning.pose import pointing, pose
from rack.levels.tables import RobotConfig
from rack.levels.task.window import ShownWindow, is_free, next_free

FARTHEST_RAD = 1e3
"""No joint is sent farther; what it can reach the level below knows."""


class Detour:
    """The goto that stands. `move` is its id on the bus, 0 as long as the program is not left.

    `holds`: the arm must rest before the program can be left. `until`: nothing of it from that move on is to begin.
    """

    def __init__(self, robot: RobotConfig, move: int = 0) -> None:
        self._robot = robot
        self._goal: Message | None = None
        self._is_new = False
        self.move = move
        self.holds = False
        self.until: int | None = None

    @property
    def is_known(self) -> bool:
        """Whether the goal of the move is known: not where this board has died and a hold came after the goto."""
        return self._goal is not None

    def described(self, orders: Orders) -> str:
        """Return, as a reason, what the goto that stands has come to, and what ends it."""
        goal = described(Operation.GOTO, self._goal.goal) if self._goal is not None else "goto"
        stage = "done" if orders.answer is Answer.DONE else "under way"
        return f"diverted by the operator: {goal} {stage}; `resume` goes on"

    def begin(self, message: Message, orders: Orders, is_new: bool) -> None:
        """Take up a goto, an `OPERATOR_COMMAND`, or refuse it; one that is not new goes on under the id that it has."""
        goal = Message(message.record.dtype)
        goal.copy_from(message)
        try:
            if goal.goal == Goal.JOINTS:
                self._joints(goal)
            elif goal.goal != Goal.HOME:
                _checked(goal)
        except ValueError as error:
            orders.refuse(str(error))
            return
        self._goal, self._is_new = goal, is_new

    def step(self, orders: Orders, plan: Message, done: int, below: Message, window: ShownWindow) -> int:
        """Go on by one cycle; return how many of the plan's moves are done: at most one less than `done`."""
        self.holds, self.until = False, None
        if orders.standing is Operation.NONE and self.move:
            window.renumber(done)
            self.move = 0
        elif orders.standing is Operation.GOTO and self.move:
            if self._is_new:
                self.move = window.jump()
            self._follow(orders, below, window)
        elif orders.standing is Operation.GOTO:
            done = self._leave(orders, plan, done, below, window)
        self._is_new = False
        return done

    def _leave(self, orders: Orders, plan: Message, done: int, below: Message, window: ShownWindow) -> int:
        """Leave the program where it can be left; until then show no more of it than must be done first."""
        behind = is_free(plan, done - 1)
        is_begun = below.current == window.first + done
        if not is_free(plan, done) and (is_begun or not behind):
            self.until = next_free(plan, done)
            return done
        self.until, self.holds = done, True
        # By then the level below knows that nothing more is to begin, and where the arm rests it can be left.
        if below.resting and below.operator >= orders.basis:
            self.move, self.holds = window.jump(), False
            return done if is_free(plan, done) else done - 1
        return done

    def as_move(self, action: int) -> Move:
        """Return the move that is wanted, on behalf of no action; `action` is the program's next."""
        goal = self._goal
        assert goal is not None, "there is a move only for a goal"
        joints, verb, tool = np.array(self._robot.home), Verb.MOVE_JOINTS, pose(np.zeros(3), (1.0, 0.0, 0.0, 0.0))
        if goal.goal == Goal.JOINTS:
            joints = self._joints(goal)
        elif goal.goal != Goal.HOME:
            turned = goal.quaternion if goal.goal == Goal.POSE else pointing(goal.direction)
            verb, tool = Verb.MOVE, pose(goal.position, turned)
        return Move(self.move, action, verb, None, tool, joints, False, 0.0)

    def _follow(self, orders: Orders, below: Message, window: ShownWindow) -> None:
        if below.done >= self.move:
            orders.done()
        elif below.state == State.ERROR and below.done >= window.before:
            orders.fail(below.reason)

    def _joints(self, goal: Message) -> NDArray[np.float64]:
        names = self._robot.joints
        return joints_of(goal, names, np.tile((-FARTHEST_RAD, FARTHEST_RAD), (len(names), 1)))


def _checked(goal: Message) -> None:
    """Raise `ValueError` for a place or an orientation that is none."""
    turned = goal.quaternion if goal.goal == Goal.POSE else goal.direction
    if not (np.isfinite(goal.position).all() and np.isfinite(turned).all() and turned.any()):
        raise ValueError("position, quaternion or direction is not a number, or all zero")
