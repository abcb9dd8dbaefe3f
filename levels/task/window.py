"""The moves that the task level shows to the level below: part of the plan, or an operator's goto.

A goto interrupts the program during a free motion or right after one. That motion is repeated
afterwards, from the arm's position at that time. Work on an object (approach, grasp, depart) is
completed first.
"""

from __future__ import annotations

import numpy as np

from rack.backplane.message import State
from rack.levels.algebra import Array
from rack.levels.messages import WINDOW_MOVES, MoveStatus, TaskCommand, TaskPlan, Verb
from rack.levels.operator import (
    Answer,
    Goal,
    Operation,
    OperatorCommand,
    Orders,
    describe_command,
    read_joint_goal,
)
from rack.levels.planning.moves import Move
from rack.levels.planning.pose import Pose, build_pointing_quaternion, make_pose
from rack.levels.tables import RobotConfig

ID_JUMP = 2
"""Step from the newest id to the next one, so that the gap makes the level below start over."""
FIRST_ID = 1
"""Id of the plan's first move, unless an operator has intervened."""
FREE_VERBS = (Verb.MOVE, Verb.MOVE_JOINTS)
"""Kinds of moves that may be interrupted, and repeated later from another position."""
MAX_JOINT_RAD = 1e3
"""Joint goals beyond this are refused. The level below has narrower limits."""


class ShownWindow:
    """The window of moves that the level below sees, and the ids of these moves.

    The ids always increase, even if an operator inserts moves.
    """

    def __init__(self, first: int = FIRST_ID, newest: int = 0, before: int = 0) -> None:
        self.first = first  # id of the plan's first move; its move k has the id `first` + k
        self.newest = newest  # newest id shown
        # The level below has started over once it reports this id, or a later one, as done.
        self.before = before

    def reserve_id(self) -> int:
        """Return a new id, with a gap that makes the level below start over."""
        self.newest += ID_JUMP
        self.before = self.newest - 1
        return self.newest

    def renumber_plan(self, done: int) -> None:
        """Give new ids to the plan's moves, so that the level below continues at move `done`."""
        self.first = self.newest + ID_JUMP - done
        self.before = self.first + done - 1

    def find_interruption(self, plan: TaskPlan, done: int, below: MoveStatus) -> tuple[int, bool]:
        """Find the move before which the program can be interrupted.

        Args:
            plan: The plan.
            done: Number of its moves that are done.
            below: Status of the level below.

        Returns:
            The index of the first move that must not begin, and True if the arm may come to rest
            now. It may do so during a free motion and right after one. Otherwise it first completes
            its work on an object.
        """
        is_begun = below.current == self.first + done
        if not is_free_motion(plan, done) and (is_begun or not is_free_motion(plan, done - 1)):
            return next(k for k in range(done, plan.count + 1) if is_free_motion(plan, k)), False
        return done, True

    def show_moves(self, plan: TaskPlan, done: int, command: TaskCommand, until: int) -> None:
        """Show the moves from the first one that is not done to the last one before `until`.

        At the end of the plan, the window keeps its size by including moves that are done. Moves
        that were done under other ids are not shown, because the level below would repeat them.

        Args:
            plan: The plan.
            done: Number of its moves that are done.
            command: Receives the window.
            until: First move that is not shown.
        """
        first = min(done, max(plan.count - WINDOW_MOVES, 0)) if self.first == FIRST_ID else done
        count = max(0, min(WINDOW_MOVES, until - first))
        command.moves[:count] = plan.moves[first : first + count]
        command.moves["id"][:count] = np.arange(count) + (self.first + first)
        self._finish_window(command, count)

    def show_only(self, move: Move, command: TaskCommand) -> None:
        """Show `move` as the only move of the window."""
        move.write_to(command.moves[0])
        self._finish_window(command, 1)

    def _finish_window(self, command: TaskCommand, count: int) -> None:
        """Set count and id of a command with `count` moves, and clear its unused moves."""
        command.count = count
        # Unused moves are cleared, so that equal windows have equal bytes.
        command.moves[count:] = np.zeros((), command.moves.dtype)
        if count:
            self.newest = max(self.newest, int(command.moves["id"][count - 1]))
        command.id = self.newest


def is_free_motion(plan: TaskPlan, k: int) -> bool:
    """Return True if move `k` of the plan is a free motion, or if the plan has no move `k`."""
    return not 0 <= k < plan.count or plan.moves["verb"][k] in FREE_VERBS


class Detour:
    """An operator's goto: a single move that interrupts the program."""

    def __init__(
        self, robot: RobotConfig, orders: Orders, window: ShownWindow, move: int = 0
    ) -> None:
        self._robot = robot
        self._orders = orders
        self._window = window
        self._goal = Goal.NONE
        self._target: tuple[Verb, Pose, Array] | None = None  # kind of move, and its end
        self._is_new = False
        self.move = move  # id of the goto on the bus. 0 if the program is not interrupted
        self.holds = False  # True while the arm must come to rest before the interruption
        self.until: int | None = None  # first move of the program that must not begin

    def format_reason(self) -> str:
        """Return text that describes the state of the goto and the command that ends it."""
        stage = "done" if self._orders.answer is Answer.DONE else "under way"
        return (
            f"diverted by the operator: {describe_command(Operation.GOTO, self._goal)} {stage};"
            " `resume` continues the program"
        )

    def accept_command(self, message: OperatorCommand, is_new: bool) -> None:
        """Accept a goto, or refuse an invalid one. If `is_new` is False, its move keeps its id."""
        try:
            self._target = self._read_goal(message)
        except ValueError as error:
            self._orders.refuse_newest(str(error))
            return
        self._goal = Goal(message.goal)
        self._is_new = is_new

    def step(self, plan: TaskPlan, done: int, below: MoveStatus) -> int:
        """Begin, track or end the goto, as the operator's command in force requires.

        Args:
            plan: The plan.
            done: Number of its moves that are done.
            below: Status of the level below.

        Returns:
            Number of the plan's moves that are done: `done`, or one less if a move must be
            repeated.
        """
        self.holds = False
        self.until = None
        standing = self._orders.standing
        if standing is Operation.NONE and self.move:
            self._window.renumber_plan(done)
            self.move = 0
        elif standing is Operation.GOTO and self.move:
            if self._is_new:
                self.move = self._window.reserve_id()
            self._track_progress(below)
        elif standing is Operation.GOTO:
            done = self._interrupt_program(plan, done, below)
        self._is_new = False
        return done

    def _interrupt_program(self, plan: TaskPlan, done: int, below: MoveStatus) -> int:
        """Interrupt the program as soon as the moves that must be completed first are done.

        Returns:
            Number of the plan's moves that are done: `done`, or one less if a move must be
            repeated.
        """
        self.until, self.holds = self._window.find_interruption(plan, done, below)
        # The program can be interrupted once the arm rests and the level below has received the
        # window without further moves.
        if self.holds and below.resting and below.operator >= self._orders.basis:
            self.move = self._window.reserve_id()
            self.holds = False
            return done if is_free_motion(plan, done) else done - 1
        return done

    def to_move(self, action: int) -> Move | None:
        """Return the goto as an elemental move, or None if its goal is not known.

        The goal is lost if this board is restarted after a hold has followed the goto. `action` is
        the number of the program's next action, although the move does not belong to it.
        """
        if self._target is None:
            return None
        verb, tool, joints = self._target
        return Move(self.move, action, verb, None, tool, joints, False, 0.0)

    def _track_progress(self, below: MoveStatus) -> None:
        """Report the goto to the operator as done or failed, once the level below does so."""
        if below.done >= self.move:
            self._orders.report_done()
        elif below.state == State.ERROR and below.done >= self._window.before:
            self._orders.abandon_command(below.reason)

    def _read_goal(self, message: OperatorCommand) -> tuple[Verb, Pose, Array]:
        """Return the kind of move to the goal, and its tool pose and joint positions.

        Raises:
            ValueError: The goal is invalid.
        """
        joints = np.array(self._robot.home)
        tool = make_pose(np.zeros(3), (1.0, 0.0, 0.0, 0.0))
        goal = message.goal
        if goal == Goal.JOINTS:
            names = self._robot.joints
            ranges = np.tile((-MAX_JOINT_RAD, MAX_JOINT_RAD), (len(names), 1))
            joints = read_joint_goal(message, names, ranges)
        if goal in (Goal.JOINTS, Goal.HOME):
            return Verb.MOVE_JOINTS, tool, joints
        turned = np.array(message.quaternion if goal == Goal.POSE else message.direction)
        position = np.array(message.position)
        if not (np.isfinite(position).all() and np.isfinite(turned).all() and turned.any()):
            raise ValueError("position, quaternion or direction is not finite, or all zero")
        tool = make_pose(
            position, turned if goal == Goal.POSE else build_pointing_quaternion(turned)
        )
        return Verb.MOVE, tool, joints
