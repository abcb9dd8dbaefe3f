"""The moves that the task level shows to the level below: a window on the plan, or an operator's
goto instead.

A goto interrupts the program during a free motion or right after one; that motion is repeated
afterwards, from the arm's position at that time. Work on an object is completed first: approach,
grasp, depart.
"""

from __future__ import annotations

import numpy as np

from rack.backplane.message import State
from rack.levels.algebra import Array
from rack.levels.messages import WINDOW, MoveStatus, TaskCommand, TaskPlan, Verb
from rack.levels.operator import (
    Answer,
    Goal,
    Operation,
    OperatorCommand,
    Orders,
    described,
    joints_of,
)
from rack.levels.planning.moves import Move
from rack.levels.planning.pose import Pose, pointing, pose
from rack.levels.tables import RobotConfig

JUMP = 2
"""Step from the newest id shown to the next: a gap makes the level below start anew."""
FIRST_ID = 1
"""Id of the plan's first move, until an operator has intervened."""
FREE = (Verb.MOVE, Verb.MOVE_JOINTS)
"""Moves that may be interrupted and repeated later from another position."""
MAX_JOINT_RAD = 1e3
"""Joint goals beyond this are refused; narrower limits are those of the level below."""


class ShownWindow:
    """Numbers the moves on the bus: ids always rise, even if an operator inserts moves."""

    def __init__(self, first: int = FIRST_ID, newest: int = 0, before: int = 0) -> None:
        self.first = first  # id of the plan's first move: its k-th is `first` + k
        self.newest = newest  # newest id shown
        self.before = before  # the level below has started anew once it has done this id

    def jump(self) -> int:
        """Return an id with which the level below starts anew."""
        self.newest += JUMP
        self.before = self.newest - 1
        return self.newest

    def renumber(self, done: int) -> None:
        """Show the plan anew from its move `done` on."""
        self.first = self.newest + JUMP - done
        self.before = self.first + done - 1

    def done(self, below: MoveStatus) -> int:
        """Return how many of the plan's moves the level below reports done."""
        return below.done - self.first + 1

    def breaking_off(self, plan: TaskPlan, done: int, below: MoveStatus) -> tuple[int, bool]:
        """Return the first move that must not begin so that the plan is broken off, and whether the
        arm may rest now.

        It may during a free motion and right after one; else the work on an object comes first.
        """
        is_begun = below.current == self.first + done
        if not is_free(plan, done) and (is_begun or not is_free(plan, done - 1)):
            return next(k for k in range(done, plan.count + 1) if is_free(plan, k)), False
        return done, True

    def show(self, plan: TaskPlan, done: int, command: TaskCommand, until: int) -> None:
        """Show the moves from the first one that is not done up to `until`, none before it; after
        the last, the window stays.

        Moves that were done under other ids are not shown again: the level below would repeat them.
        """
        first = min(done, max(plan.count - WINDOW, 0)) if self.first == FIRST_ID else done
        count = max(0, min(WINDOW, until - first))
        command.moves[:count] = plan.moves[first : first + count]
        command.moves["id"][:count] = np.arange(count) + (self.first + first)
        self._end(command, count)

    def show_one(self, move: Move, command: TaskCommand) -> None:
        """Show one move alone."""
        move.write_to(command.moves[0])
        self._end(command, 1)

    def _end(self, command: TaskCommand, count: int) -> None:
        command.count = count
        # Equal windows have equal bytes.
        command.moves[count:] = np.zeros((), command.moves.dtype)
        if count:
            self.newest = max(self.newest, int(command.moves["id"][count - 1]))
        command.id = self.newest


def is_free(plan: TaskPlan, k: int) -> bool:
    """Return whether move `k` of the plan is a free motion; before the first and after the last
    move, True.
    """
    return not 0 <= k < plan.count or plan.moves["verb"][k] in FREE


class Detour:
    """An operator's goto: one move instead of the program's, then the rest of the program."""

    def __init__(
        self, robot: RobotConfig, orders: Orders, window: ShownWindow, move: int = 0
    ) -> None:
        self._robot = robot
        self._orders = orders
        self._window = window
        self._goal = Goal.NONE
        self._target: tuple[Verb, Pose, Array] | None = None  # kind of move, and its end
        self._is_new = False
        self.move = move  # id of the goto on the bus; 0: the program is not interrupted
        self.holds = False  # the arm must rest before the program can be interrupted
        self.until: int | None = None  # the first move of the program that must not begin

    @property
    def is_known(self) -> bool:
        """False if this board was restarted and a hold came after the goto: the goal is then
        lost.
        """
        return self._target is not None

    def reason(self) -> str:
        """Return the state of the goto, and the command that ends it."""
        goal = described(Operation.GOTO, self._goal)
        stage = "done" if self._orders.answer is Answer.DONE else "under way"
        return f"diverted by the operator: {goal} {stage}; `resume` continues the program"

    def begin(self, message: OperatorCommand, is_new: bool) -> None:
        """Accept a goto, an `OPERATOR_COMMAND`, or refuse it; one that is not new continues under
        its id.
        """
        try:
            self._target = self._read(message)
        except ValueError as error:
            self._orders.refuse(str(error))
            return
        self._goal = Goal(message.goal)
        self._is_new = is_new

    def step(self, plan: TaskPlan, done: int, below: MoveStatus) -> int:
        """Advance by one cycle; return how many of the plan's moves are done: `done`, or one
        less.
        """
        self.holds = False
        self.until = None
        standing = self._orders.standing
        if standing is Operation.NONE and self.move:
            self._window.renumber(done)
            self.move = 0
        elif standing is Operation.GOTO and self.move:
            if self._is_new:
                self.move = self._window.jump()
            self._follow(below)
        elif standing is Operation.GOTO:
            done = self._leave(plan, done, below)
        self._is_new = False
        return done

    def _leave(self, plan: TaskPlan, done: int, below: MoveStatus) -> int:
        """Interrupt the program where possible; until then show only the moves that must be done
        first.
        """
        self.until, self.holds = self._window.breaking_off(plan, done, below)
        if not self.holds:
            return done
        # At rest, the program can be interrupted once the level below has received the window
        # without further moves.
        if below.resting and below.operator >= self._orders.basis:
            self.move = self._window.jump()
            self.holds = False
            return done if is_free(plan, done) else done - 1
        return done

    def as_move(self, action: int) -> Move:
        """Return the goto as a move; `action` is the program's next, though the move serves
        none.
        """
        assert self._target is not None, "there is a move only for a goal"
        verb, tool, joints = self._target
        return Move(self.move, action, verb, None, tool, joints, False, 0.0)

    def _follow(self, below: MoveStatus) -> None:
        if below.done >= self.move:
            self._orders.done()
        elif below.state == State.ERROR and below.done >= self._window.before:
            self._orders.fail(below.reason)

    def _read(self, message: OperatorCommand) -> tuple[Verb, Pose, Array]:
        """Return the kind of move to a goal, and its end. Raises `ValueError` for an invalid
        one.
        """
        joints = np.array(self._robot.home)
        tool = pose(np.zeros(3), (1.0, 0.0, 0.0, 0.0))
        goal = message.goal
        if goal == Goal.JOINTS:
            names = self._robot.joints
            ranges = np.tile((-MAX_JOINT_RAD, MAX_JOINT_RAD), (len(names), 1))
            joints = joints_of(message, names, ranges)
        if goal in (Goal.JOINTS, Goal.HOME):
            return Verb.MOVE_JOINTS, tool, joints
        turned = np.array(message.quaternion if goal == Goal.POSE else message.direction)
        position = np.array(message.position)
        if not (np.isfinite(position).all() and np.isfinite(turned).all() and turned.any()):
            raise ValueError("position, quaternion or direction is not finite, or all zero")
        tool = pose(position, turned if goal == Goal.POSE else pointing(turned))
        return Verb.MOVE, tool, joints
