"""The executor of the elemental move level: supplies the primitive level with segments."""

from __future__ import annotations

from typing import Any

from rack.backplane.message import State
from rack.levels.elemental_move.pipeline import (
    ElementalMoveParams,
    PlanStore,
    SegmentWindow,
    can_join,
)
from rack.levels.level import OPERATOR, Executor, Input, LevelContext, Output
from rack.levels.messages import (
    SEGMENTS,
    Error,
    MoveCommand,
    MovePlan,
    MoveStatus,
    PrimitiveStatus,
    SegmentKind,
    TaskCommand,
    Verb,
)
from rack.levels.operator import (
    ABOVE_LOST,
    BELOW_LOST,
    HELD_FROM_ABOVE,
    HOLD_COMMANDS,
)


class ElementalMoveExecutor(Executor):
    """Hands the segments of planned moves to the primitive level.

    If an obstacle blocks the arm, the executor requests another path from its planner. After a
    restart of its board it continues from its own last command and status. The arm stops on its
    path while the board above is lost, or while the level above or an operator commands `hold`.
    """

    above = Input(TaskCommand, "above.command")
    below = Input(PrimitiveStatus, "below.status")
    plan = Input(MovePlan, "own.plan")
    last_command = Input(MoveCommand, "own.command")
    last_status = Input(MoveStatus, "own.status")
    operator = OPERATOR
    # The status is written first. A board killed between the two finds done moves in its window
    # after the restart, and removes them again.
    status = Output(MoveStatus, rests_on=below)
    command = Output(MoveCommand, rests_on=above)
    commands = HOLD_COMMANDS
    params = ElementalMoveParams
    settings: ElementalMoveParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._gripper = context.robot.gripper
        self._plans = PlanStore()
        self._started = False
        self._done = 0  # id of the newest move done
        self._handed_down = 0  # id of the newest move handed down
        self._request = 0  # open request for another path, or 0
        self._replans_of_move = 0  # number of other paths taken by the present move
        self._waiting_since: int | None = None  # tick of the first refusal of the awaited path
        self._error = Error.NONE
        self._reason = ""

    def process(self, tick: int) -> None:
        """Run one cycle: read command, status and plan, and fill the window of segments."""
        segments = SegmentWindow(self.command)
        if not self._started:
            self._restore_state(segments)
        command = self.above
        status = self.below.message
        self._orders.take_commands(self.operator)
        self._plans.store_plan(self.plan, self._done, self._handed_down, self.status.end)
        self._restart_on_new_window(command.message, status, segments)
        if not self._error:
            # Remove finished segments. A grasp that has closed on nothing is an error.
            while (taken := segments.pop_done(status.done)) is not None:
                self._done = int(taken["move"])
                self._replans_of_move = 0
                if taken["kind"] == SegmentKind.GRIPPER and (
                    shut := self._describe_empty_grip(status, taken["opening"])
                ):
                    self._set_error(Error.GRASP_MISSED, f"{shut}: it holds nothing")
            self._check_below(status, segments)
        if not self._error:
            self._replan_if_blocked(status, segments, tick)
            self._fill_window(command.message, segments, tick)
        if self._error:
            segments.withdraw_all()
        held = command.is_lost or command.message.hold or self._orders.is_holding
        self.command.hold = self._request > 0 or self._error > 0 or held
        self._write_status(segments, self.status)
        self._answer_operator()

    def _restore_state(self, segments: SegmentWindow) -> None:
        """Continue from the last command and status in the mailboxes. Stored plans are lost."""
        self._started = True
        self.status.end = self.below.message.position
        if self.last_command.has_message and self.last_status.has_message:
            last = self.last_status.message
            self.command.copy_from(self.last_command.message)
            self._done = last.done
            self.status.replans = last.replans
            if last.state == State.ERROR:
                self._set_error(Error(last.error), last.reason)
            self._handed_down = max(last.done, *self.command.segments["move"].tolist())
            if self._handed_down >= last.planned:
                self.status.end = last.end
            end = segments.find_path_end()
            if end is not None:
                self.status.end = end

    def _restart_on_new_window(
        self, command: TaskCommand, status: PrimitiveStatus, segments: SegmentWindow
    ) -> None:
        """Start a new window of moves that does not continue the previous one.

        All segments are withdrawn at once. The new window begins when the arm is at rest.

        Args:
            command: Command that contains the window.
            status: Status of the primitive level.
            segments: Segments handed down so far.
        """
        first = int(command.moves["id"][0]) if command.count else 0
        if first <= self._handed_down + 1:
            return
        segments.withdraw_all()
        self._close_request()
        if status.resting or not self._handed_down:
            self._done = self._handed_down = first - 1
            self._error = Error.NONE
            self._reason = ""

    def _check_below(self, status: PrimitiveStatus, segments: SegmentWindow) -> None:
        """Set the error if the level below has failed or the held object is lost."""
        if status.state == State.ERROR:
            self._set_error(Error(status.error), status.reason)
        moving = segments.count and segments.first["kind"] == SegmentKind.PATH
        if moving and status.held >= 0 and (shut := self._describe_empty_grip(status)):
            self._set_error(Error.OBJECT_LOST, f"{shut}: the object is lost")

    def _replan_if_blocked(
        self, status: PrimitiveStatus, segments: SegmentWindow, tick: int
    ) -> None:
        """Request another path if an obstacle blocks the arm at rest, and hand down the answer.

        The request is cancelled when the path is free again. If the arm is still blocked after
        `replans` other paths for the same move, the error is set.

        Args:
            status: Status of the primitive level.
            segments: Segments handed down.
            tick: Tick of the cycle.
        """
        blocked = bool(
            segments.count
            and status.blocked
            and status.resting
            and segments.first["id"] == status.current
            and segments.first["kind"] == SegmentKind.PATH
        )
        if not blocked:
            self._close_request()
        elif not self._request and self._replans_of_move >= self.settings.replans:
            self._set_error(
                Error.BLOCKED, f"{self._replans_of_move} other paths tried, still {status.reason}"
            )
        elif not self._request:
            # The number of the cycle serves as the id. It stays unique across restarts.
            self._request = tick // self.context.every
        elif (plan := self._plans.find_answer(self._request)) is not None:
            if plan.error:
                self._wait_for_path(plan, tick)
            elif not can_join(plan, status.position):
                # The arm has moved since the request, so the path starts at the wrong position.
                self._request = tick // self.context.every
            else:
                segments.replace_first(plan)
                self._handed_down = plan.move
                self._close_request()
                self.status.replans += 1
                self._replans_of_move += 1

    def _close_request(self) -> None:
        """Cancel the request for another path, if one is open."""
        if self._request:
            self._request = 0
            self._waiting_since = None
            self._reason = ""

    def _fill_window(self, command: TaskCommand, segments: SegmentWindow, tick: int) -> None:
        """Hand down the next planned moves until the window of segments is full."""
        while not (self._request or self._error or segments.count >= SEGMENTS):
            move = find_move(command.moves[: command.count], self._handed_down + 1)
            if move is None or not self._hand_down(move, segments, tick):
                return
            self._handed_down += 1
            self._waiting_since = None
            self._reason = ""

    def _hand_down(self, move: Any, segments: SegmentWindow, tick: int) -> bool:
        """Hand down one move as a segment.

        Returns:
            True if the move was handed down. False if it has no path yet, or if it needs a gripper
            and the robot has none.
        """
        if move["verb"] in (Verb.GRASP, Verb.RELEASE):
            gripper = self._gripper
            if gripper is None:
                self._set_error(
                    Error.UNREACHABLE, f"move {move['id']} needs a gripper; the robot has none"
                )
                return False
            opening = gripper.closed if move["verb"] == Verb.GRASP else gripper.open
            segments.add_gripper(move, opening, gripper.force)
            return True
        plan = self._plans.find_plan(int(move["id"]))
        if plan is None:
            return False
        if plan.error:
            if not segments.count:
                self._wait_for_path(plan, tick)
            return False
        # A status from below is read up to a cycle late, and the status of this level becomes
        # visible another cycle later. The segment must therefore end before the move's deadline.
        by_s = float(move["by"])
        below_s = by_s - 2.0 * self.context.period_s - self.settings.answer
        segments.add_path(move, plan, below_s if by_s > 0.0 else 0.0)
        return True

    def _wait_for_path(self, refusal: MovePlan, tick: int) -> None:
        """Wait for a free path after the planner has refused a move.

        The error is set after `patience`, or at once if the refusal is not NO_PATH.
        """
        if self._waiting_since is None:
            self._waiting_since = tick
        self._reason = refusal.reason
        waited_s = (tick - self._waiting_since) * self.context.tick_s
        if refusal.error != Error.NO_PATH or waited_s > self.settings.patience:
            self._set_error(Error(refusal.error), refusal.reason)

    def _describe_empty_grip(self, status: PrimitiveStatus, wanted: float | None = None) -> str:
        """Return how far the gripper has closed, as text. Empty if it seems to hold something.

        Args:
            status: Status with the opening.
            wanted: Commanded opening. If it is neither the closed opening nor None, nothing is
                checked and the text is empty.
        """
        gripper = self._gripper
        if gripper is None or wanted not in (None, gripper.closed):
            return ""
        opening_gap = status.opening - gripper.closed
        if not abs(opening_gap) < (self.settings.grasp_gap or gripper.rest_threshold):
            return ""
        # Report a fraction of the travel, because an opening may be a length or an angle.
        travel = gripper.open - gripper.closed
        return f"the gripper has closed to {opening_gap / travel:.1%} of its way"

    def _set_error(self, error: Error, reason: str) -> None:
        """Set the error of the present window of moves, unless it already has one."""
        if not self._error:
            self._error = error
            self._reason = reason
            self._request = 0

    def _write_status(self, segments: SegmentWindow, report: MoveStatus) -> None:
        """Fill the status: the state, the moves done and planned, and the planned end position."""
        command = self.above.message
        status = self.below.message
        report.echo = command.id
        report.state = self._find_state(command)
        waits = ""
        if report.state == State.EXECUTING and (waits := self._find_wait_reason()):
            report.state = State.HOLDING
        report.error = self._error
        report.reason = self._reason if self._error else waits
        report.operated = status.operated or self._orders.is_in_force
        # Report the moves done, and the progress of the present one.
        window = command.moves[: command.count]
        under_way = segments.first
        report.done = self._done
        report.held = status.held
        report.current = int(under_way["move"])
        is_begun = segments.count and under_way["id"] == status.current
        report.progress = status.progress if is_begun else 0.0
        move = find_move(window, report.current)
        report.verb = Verb.NONE if move is None else move["verb"]
        # The planner continues from the last move that is reported as planned.
        report.planned = self._plans.find_last_planned_move(window, self._handed_down)
        end = self._plans.find_path_end(report.planned)
        if end is None:
            # No plan is stored if the path was handed down before a restart, or replaced such a
            # path. The window of segments still contains it.
            end = segments.find_path_end()
        if report.planned <= self._done and status.resting:
            report.end = status.position
        elif end is not None:
            report.end = end
        report.replan = self._request
        report.start = status.position

    def _answer_operator(self) -> None:
        """Report the operator's commands, and pass down the serial of the newest one in effect."""
        above = self.above.message.operator
        below = self.below.message
        self.command.operator = self._orders.find_basis(above)
        # The arm only counts as at rest once the level below has received the command.
        self.status.resting = below.resting and below.operator >= self.command.operator
        if self.status.resting:
            self._orders.report_done()
        self._orders.fill_status(self.status, above)

    def _find_wait_reason(self) -> str:
        """Return why the level waits and what ends the wait. Empty if it does not wait."""
        command = self.above
        below = self.below
        if self._orders.is_in_force:
            return self._orders.format_reason(self.context.board)
        if command.is_lost:
            return ABOVE_LOST
        if below.is_lost:
            return BELOW_LOST
        if self._reason:
            return self._reason
        if below.message.state == State.HOLDING and below.message.reason != HELD_FROM_ABOVE:
            return below.message.reason
        return HELD_FROM_ABOVE if command.message.hold else ""

    def _find_state(self, command: TaskCommand) -> State:
        """Return the state of the moves. During a wait, `_write_status` reports HOLDING instead."""
        if self._error:
            return State.ERROR
        if not command.id:
            return State.IDLE
        return State.DONE if self._done >= command.id else State.EXECUTING


def find_move(window: Any, serial: int) -> Any:
    """Return the move with the id `serial` in a window of `ElementalMove`, or None."""
    return next((move for move in window if move["id"] == serial), None)
