"""The executor of the elemental move level: keeps the primitive level supplied with segments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from rack.backplane.message import Message, MessageType, State
from rack.levels.elemental_move.params import ElementalMoveParams
from rack.levels.elemental_move.plans import PlansAtHand, joins
from rack.levels.elemental_move.segments import SegmentWindow
from rack.levels.level import Executor, Input, LevelContext, Ports, Reading
from rack.levels.messages import (
    MOVE_COMMAND,
    MOVE_PLAN,
    MOVE_STATUS,
    PRIMITIVE_STATUS,
    TASK_COMMAND,
    Error,
    SegmentKind,
    Verb,
)
from rack.levels.operator import ABOVE_LOST, BELOW_LOST, HELD_FROM_ABOVE, OPERATOR_COMMAND, Commands, Operation, Orders
from rack.levels.tables import read_params


class ElementalMoveExecutor(Executor):
    """Hands segments down as soon as their plans are there, and asks for another path where the arm is blocked.

    It reads back what it wrote itself, so that it goes on where it was when its board has been restarted. While the
    board above is lost, it says hold, or an operator does, the arm is held on its path.
    """

    inputs: ClassVar[Mapping[str, Input]] = {
        "command": Input(TASK_COMMAND, "above.command"),
        "status": Input(PRIMITIVE_STATUS, "below.status"),
        "plan": Input(MOVE_PLAN, "own.plan"),
        "last_command": Input(MOVE_COMMAND, "own.command"),
        "last_status": Input(MOVE_STATUS, "own.status"),
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
    }
    # The status first: killed between the two, the board finds a window whose done moves it only takes out again.
    outputs: ClassVar[Mapping[str, MessageType]] = {"status": MOVE_STATUS, "command": MOVE_COMMAND}
    commands: ClassVar[Commands] = {Operation.HOLD: (), Operation.RESUME: ()}
    params = ElementalMoveParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._params = read_params(ElementalMoveParams, context.params)
        self._gripper = context.robot.gripper
        self._plans = PlansAtHand()
        self._orders = Orders(self.commands)
        self._started = False
        self._done = 0
        self._handed_down = 0
        self._request = 0
        self._replans = 0
        self._replans_of_move = 0
        self._waiting_since: int | None = None
        self._error = Error.NONE
        self._reason = ""

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Take up what came from above, below and the planner; keep the window of segments full."""
        segments = SegmentWindow(write.command)
        if not self._started:
            self._go_on(read, write, segments)
        status = read.status.value
        self._orders.take(read.operator)
        self._plans.take(read.plan, self._done, self._handed_down, write.status.end)
        self._take_window(read.command.value, status, segments)
        if not self._error:
            self._take_done(status, segments)
            self._watch(status, segments)
        if not self._error:
            self._mind_the_way(status, segments, tick)
            self._fill(read.command.value, segments, tick)
        if self._error:
            segments.clear()
        write.command.hold = self._request > 0 or self._error > 0 or read.command.is_lost or self._is_told_to(read)
        self._report(read, segments, write.status)
        self._answer(read, write)

    def _go_on(self, read: Ports, write: Ports, segments: SegmentWindow) -> None:
        """Go on from the last command and status in the mailboxes; plans that were at hand are lost."""
        self._started = True
        write.status.end = read.status.value.position
        if read.last_command.is_there and read.last_status.is_there:
            last = read.last_status.value
            write.command.copy_from(read.last_command.value)
            self._done, self._replans = last.done, last.replans
            if last.state == State.ERROR:
                self._fail(Error(last.error), last.reason)
            self._handed_down = max(last.done, segments.newest_move)
            if self._handed_down >= last.planned:
                write.status.end = last.end
            end = segments.end()
            if end is not None:
                write.status.end = end

    def _take_window(self, command: Message, status: Message, segments: SegmentWindow) -> None:
        """Start anew on a window that does not go on where the last one stood, once the arm rests."""
        first = int(command.moves["id"][0]) if command.count else 0
        if first <= self._handed_down + 1:
            return
        segments.clear()
        self._close_request()
        if status.resting or not self._handed_down:
            self._done = self._handed_down = first - 1
            self._error, self._reason = Error.NONE, ""

    def _take_done(self, status: Message, segments: SegmentWindow) -> None:
        """Count segments that are done; a grasp must have found something."""
        while (taken := segments.take_done(status.done)) is not None:
            self._done, self._replans_of_move = int(taken["move"]), 0
            gripper = self._gripper if taken["kind"] == SegmentKind.GRIPPER else None
            if gripper is not None and taken["opening"] == gripper.closed and self._is_shut(status):
                self._fail(Error.GRASP_MISSED, f"the gripper is shut to {status.opening * 1e3:.1f} mm, without object")

    def _watch(self, status: Message, segments: SegmentWindow) -> None:
        """Fail with the level below, and when what was held is gone."""
        if status.state == State.ERROR:
            self._fail(Error(status.error), status.reason)
        moving = segments.count and segments.first["kind"] == SegmentKind.PATH
        if moving and status.held >= 0 and self._is_shut(status):
            self._fail(Error.OBJECT_LOST, f"the gripper is shut to {status.opening * 1e3:.1f} mm: what it held is gone")

    def _mind_the_way(self, status: Message, segments: SegmentWindow, tick: int) -> None:
        """Where the arm rests because something is in its way, ask for another path; drop that when the way is free."""
        blocked = bool(
            segments.count
            and status.blocked
            and status.resting
            and segments.first["id"] == status.current
            and segments.first["kind"] == SegmentKind.PATH
        )
        if not blocked:
            self._close_request()
        elif not self._request and self._replans_of_move >= self._params.replans:
            self._fail(Error.BLOCKED, f"{self._replans_of_move} other paths tried, still {status.reason}")
        elif not self._request:
            # The cycle's number: no request of an earlier life of this board has the same.
            self._request = tick // self.context.every
        elif (plan := self._plans.anew(self._request)) is not None:
            if not (plan.error or joins(plan, status.position)):
                # The arm has been moved meanwhile.
                self._request = tick // self.context.every
                return
            if plan.error:
                self._wait(plan, tick)
                return
            segments.replace_first(plan)
            self._handed_down = int(plan.move)
            self._close_request()
            self._replans += 1
            self._replans_of_move += 1

    def _close_request(self) -> None:
        if self._request:
            self._request, self._waiting_since, self._reason = 0, None, ""

    def _fill(self, command: Message, segments: SegmentWindow, tick: int) -> None:
        """Hand down the moves behind the last one, as far as their plans are there and the window has room."""
        while not (self._request or self._error or segments.is_full):
            at = np.flatnonzero(command.moves["id"][: command.count] == self._handed_down + 1)
            if not at.size or not self._hand_down(command.moves[at[0]], segments, tick):
                return
            self._handed_down += 1
            self._waiting_since = None
            self._reason = ""

    def _hand_down(self, move: Any, segments: SegmentWindow, tick: int) -> bool:
        if move["verb"] in (Verb.GRASP, Verb.RELEASE):
            return self._hand_down_gripper(move, segments)
        plan = self._plans.of(int(move["id"]))
        if plan is None:
            return False
        if plan.error:
            if not segments.count:
                self._wait(plan, tick)
            return False
        segments.add_path(move, plan, self._time_below(float(move["by"])))
        return True

    def _hand_down_gripper(self, move: Any, segments: SegmentWindow) -> bool:
        gripper = self._gripper
        if gripper is None:
            self._fail(Error.UNREACHABLE, f"move {move['id']} needs a gripper; the robot has none")
            return False
        segments.add_gripper(move, gripper.closed if move["verb"] == Verb.GRASP else gripper.open, gripper.force)
        return True

    def _wait(self, refusal: Message, tick: int) -> None:
        """Wait for a free path as long as patience lasts; nothing else that was refused gets better by waiting."""
        if self._waiting_since is None:
            self._waiting_since = tick
        self._reason = refusal.reason
        waited_s = (tick - self._waiting_since) * self.context.tick_s
        if refusal.error != Error.NO_PATH or waited_s > self._params.patience:
            self._fail(Error(refusal.error), refusal.reason)

    def _time_below(self, by_s: float) -> float:
        """Return the time by which the level below must be done so that this level has said so at `by_s`."""
        if by_s <= 0.0:
            return 0.0
        # A status from below waits up to a cycle to be read, and what is written then shows a cycle later.
        return by_s - 2.0 * self.context.period_s - self._params.answer

    def _is_shut(self, status: Message) -> bool:
        gripper = self._gripper
        return gripper is not None and abs(status.opening - gripper.closed) < self._params.grasp_gap

    def _fail(self, error: Error, reason: str) -> None:
        if not self._error:
            self._error, self._reason = error, reason
            self._request = 0

    def _report(self, read: Ports, segments: SegmentWindow, report: Message) -> None:
        command, status = read.command, read.status.value
        report.echo = command.value.id
        report.state = self._state(command.value)
        kept_from = self._kept_from(command, read.status) if report.state == State.EXECUTING else ""
        if kept_from:
            report.state = State.HOLDING
        report.error, report.reason = self._error, self._reason if self._error else kept_from
        report.operated = status.operated or self._orders.standing is not Operation.NONE
        self._report_work(command.value, status, segments, report)

    def _report_work(self, command: Message, status: Message, segments: SegmentWindow, report: Message) -> None:
        """Say what is done, and how far the move under way has come."""
        under_way = segments.first if segments.count else None
        report.done, report.held, report.replans = self._done, status.held, self._replans
        report.current = int(under_way["move"]) if under_way is not None else 0
        is_begun = under_way is not None and under_way["id"] == status.current
        report.progress = status.progress if is_begun else 0.0
        under_way_at = np.flatnonzero(command.moves["id"][: command.count] == report.current)
        report.verb = int(command.moves["verb"][under_way_at[0]]) if report.current and under_way_at.size else Verb.NONE
        self._report_plans(command, status, segments, report)
        report.replan = self._request
        report.start = status.position

    def _report_plans(self, command: Message, status: Message, segments: SegmentWindow, report: Message) -> None:
        """Say how far plans are at hand: from there the planner goes on."""
        report.planned = self._plans.reach(command.moves[: command.count], self._handed_down)
        end = self._plans.end(report.planned)
        if end is None:
            # Handed down before this board started anew, or in place of such a path since.
            end = segments.end()
        if report.planned <= self._done and status.resting:
            report.end = status.position
        elif end is not None:
            report.end = end

    def _is_told_to(self, read: Ports) -> bool:
        """Say whether the level above, or an operator here, says hold."""
        return bool(read.command.value.hold) or self._orders.standing is Operation.HOLD

    def _answer(self, read: Ports, write: Ports) -> None:
        """Answer the operator, and hand down what this cycle rests on."""
        above, below = read.command.value.operator, read.status.value
        write.command.operator = self._orders.rests_on(above)
        # What rests must have heard of it.
        write.status.resting = below.resting and below.operator >= write.command.operator
        if write.status.resting:
            self._orders.done()
        self._orders.report(write.status, above)

    def _kept_from(self, command: Reading, below: Reading) -> str:
        """Return who or what keeps the level from its work, and what ends that; empty: nothing does."""
        if self._orders.standing is not Operation.NONE:
            return self._orders.keeps(self.context.board)
        if command.is_lost:
            return ABOVE_LOST
        if below.is_lost:
            return BELOW_LOST
        if self._reason:
            return self._reason
        if below.value.state == State.HOLDING and below.value.reason != HELD_FROM_ABOVE:
            return str(below.value.reason)
        return HELD_FROM_ABOVE if command.value.hold else ""

    def _state(self, command: Message) -> State:
        if self._error:
            return State.ERROR
        if not command.id:
            return State.IDLE
        return State.DONE if self._done >= command.id else State.EXECUTING
