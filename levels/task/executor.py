"""The executor of the task level, which hands down the moves of the plan and tracks them."""

from __future__ import annotations

from typing import ClassVar

from rack.backplane.message import State
from rack.levels.level import OPERATOR, Executor, Input, LevelContext, Output, Program, Reading
from rack.levels.messages import Error, MoveStatus, TaskCommand, TaskPlan, TaskStatus
from rack.levels.operator import (
    BELOW_LOST,
    HELD_FROM_ABOVE,
    HOLD_COMMANDS,
    Goal,
    Operation,
    OperatorCommand,
    find_answered_serial,
)
from rack.levels.task.program import ROUNDING_S, AnyAction, TaskConfig, TaskParams, read_program
from rack.levels.task.window import Detour, ShownWindow


class TaskExecutor(Executor):
    """Hands down the moves of the plan and reports when the program is done.

    It ends the program with an error if the plan is refused, a move fails in the level below, an
    action is late, or nothing moves. An operator may hold the program, or send the arm elsewhere
    between two moves.
    """

    below = Input(MoveStatus, "below.status")
    plan = Input(TaskPlan, "own.plan")
    last_command = Input(TaskCommand, "own.command")
    last_status = Input(TaskStatus, "own.status")
    operator = OPERATOR
    command = Output(TaskCommand)
    status = Output(TaskStatus, rests_on=below)
    commands = {
        **HOLD_COMMANDS,
        Operation.GOTO: (Goal.JOINTS, Goal.POSE, Goal.DIRECTION, Goal.HOME),
    }
    params: ClassVar[type[TaskParams]] = TaskParams
    settings: TaskParams
    program: ClassVar[type[Program] | None] = TaskConfig

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._actions = self._read_first_actions()
        self._ahead_s = 0.0  # s: time on the clock of the actions' `by`, minus simulated time
        self._window = ShownWindow()
        self._detour = Detour(context.robot, self._orders, self._window)
        self._started = False
        self._done = 0  # completed moves of the plan
        self._error = Error.NONE
        self._reason = ""
        self._progress: tuple[float, ...] = ()  # values that change while anything moves
        self._moved_at = 0  # tick of their last change

    def process(self, tick: int) -> None:
        """Track progress, obey the operator, and hand down the next moves of the plan."""
        if not self._started:
            self._restore_state()
        self._orders.take_commands(self.operator, self._check_command)
        plan = self._find_plan(tick)
        below = self.below.message
        if not self._error:
            self._track_progress(plan, below)
            # Fail if an action is not done by its deadline.
            now_s = tick * self.context.tick_s + self._ahead_s
            done = self._count_done_actions(plan)
            for k in range(done, len(self._actions)):
                by_s = self._actions[k].by
                if by_s is not None and now_s > by_s + ROUNDING_S and not self._error:
                    self._error = Error.TOO_LATE
                    self._reason = self._format_reason(
                        k, f", {self._actions[k]}, was not done by {by_s:g} s"
                    )
        self._done = self._interrupt_program(plan, below)
        waits = self._find_reason_to_wait(self.below)
        if self._compute_state(plan) == State.EXECUTING:
            self._check_progress(plan, waits, tick)
        self._hand_down_moves(plan, self.command)
        self._write_status(plan, waits)
        self._answer_operator(below)

    def _read_first_actions(self) -> tuple[AnyAction, ...]:
        """Return the actions with which the level starts: the whole program."""
        return read_program(self.context.task, self.context.robot, self.context.scene).action

    def _find_plan(self, tick: int) -> TaskPlan:
        """Return the plan for the present actions. If there is none yet, all its fields are 0."""
        return self.plan.message

    def _restore_state(self) -> None:
        """Restore the state from the last command and status, after a restart of the board."""
        self._started = True
        last = self.last_status.message
        self._done = last.moves_done
        self._error = Error(last.error)
        self._reason = last.reason
        if self.last_status.has_message and self.last_command.has_message:
            before = (last.detour or last.first + self._done) - 1
            self._window = ShownWindow(last.first, self.last_command.message.id, before)
            self._detour = Detour(self.context.robot, self._orders, self._window, last.detour)

    def _check_command(self, command: OperatorCommand) -> None:
        """Accept or refuse a goto. Other commands need no check.

        A goto that was answered before this board was restarted is not new.
        """
        if self._orders.standing is Operation.GOTO:
            answered = find_answered_serial(self.last_status.message)
            self._detour.accept_command(command, command.id > answered)

    def _track_progress(self, plan: TaskPlan, below: MoveStatus) -> None:
        """Count completed moves, and detect errors of the plan and the level below."""
        if plan.error:
            self._error = Error(plan.error)
            self._reason = plan.reason
        elif plan.count and not self._detour.move:
            self._done = min(max(self._done, below.done - self._window.first + 1), plan.count)
        failed = below.state == State.ERROR and below.done >= self._window.before
        if failed and not self._detour.move and self._done < plan.count:
            action = int(plan.moves["action"][self._done])
            self._error = Error(below.error)
            self._reason = self._format_reason(action, f": {below.reason}")

    def _format_reason(self, action: int, why: str) -> str:
        """Return "action N" followed by `why`, which begins with a separator."""
        return f"action {action}{why}"

    def _interrupt_program(self, plan: TaskPlan, below: MoveStatus) -> int:
        """Begin, track or end an operator's goto. Return the number of completed moves."""
        return self._detour.step(plan, self._done, below)

    def _find_reason_to_wait(self, below: Reading[MoveStatus]) -> str:
        """Return why the level waits, and what ends the wait, as text.

        Empty if it does not wait.
        """
        orders = self._orders
        if orders.standing is Operation.GOTO:
            return self._detour.format_reason()
        if orders.is_in_force:
            return orders.format_reason(self.context.board)
        if below.is_lost:
            return BELOW_LOST
        is_held = below.message.state == State.HOLDING and below.message.reason != HELD_FROM_ABOVE
        return below.message.reason if is_held else ""

    def _check_progress(self, plan: TaskPlan, waits: str, tick: int) -> None:
        """Report an error if nothing has moved for too long, unless an operator prevents motion."""
        below = self.below.message
        progress = (
            plan.id,
            self._done,
            below.done,
            below.planned,
            below.current,
            below.progress,
            self._detour.move,
            *self._list_progress_values(),
        )
        operated = below.operated or self._orders.is_in_force
        if operated or progress != self._progress:
            self._progress = progress
            self._moved_at = tick
        elif (tick - self._moved_at) * self.context.tick_s > self.settings.stalled_s:
            self._error = Error.STALLED
            self._reason = (
                f"nothing has moved for {self.settings.stalled_s:g} s: "
                f"{waits or _format_awaited(plan, below)}"
            )

    def _list_progress_values(self) -> tuple[int, ...]:
        """Return further values whose change counts as progress."""
        return ()

    def _count_done_actions(self, plan: TaskPlan) -> int:
        """Return the number of completed actions of the program."""
        if not plan.count:
            return 0
        if self._done == plan.count:
            return len(self._actions)
        return int(plan.moves["action"][self._done])

    def _hand_down_moves(self, plan: TaskPlan, command: TaskCommand) -> None:
        """Show the program's next moves, or the operator's goto, to the level below."""
        detour = self._detour
        goto = detour.to_move(self._count_done_actions(plan))
        if detour.move and goto is not None and not self._error:
            self._window.show_only(goto, command)
        else:
            is_stopped = self._error or detour.move
            until = 0 if is_stopped else self._find_first_barred_move(plan)
            self._window.show_moves(plan, self._done, command, until)

    def _find_first_barred_move(self, plan: TaskPlan) -> int:
        """Return the index of the first move of the plan that must not begin yet."""
        return plan.count if self._detour.until is None else self._detour.until

    def _write_status(self, plan: TaskPlan, waits: str) -> None:
        """Write state, error and progress to the status. `waits` is the reason to wait, if any."""
        status = self.status
        status.echo = plan.id
        status.state = self._compute_state(plan)
        holds = waits and status.state == State.EXECUTING
        if holds:
            status.state = State.HOLDING
        status.error = self._error
        status.reason = self._reason if self._error else waits if holds else ""
        status.action = self._count_done_actions(plan)
        status.actions = len(self._actions)
        status.moves_done = self._done
        status.moves = plan.count
        status.first = self._window.first
        status.detour = self._detour.move

    def _answer_operator(self, below: MoveStatus) -> None:
        """Pass the operator's command to the level below, and answer the operator in the status."""
        orders = self._orders
        self.command.hold = orders.is_holding or self._detour.holds
        self.command.operator = orders.find_basis(0)
        if orders.is_holding and below.resting and below.operator >= orders.basis:
            orders.report_done()
        orders.fill_status(self.status)

    def _compute_state(self, plan: TaskPlan) -> State:
        """Return the state of the level, disregarding holds."""
        if self._error:
            return State.ERROR
        if not self._actions:
            return State.IDLE
        return State.DONE if plan.count and self._done == plan.count else State.EXECUTING


def _format_awaited(plan: TaskPlan, below: MoveStatus) -> str:
    """Return text that names the event for which a task waits if it is not held."""
    if not plan.id:
        return "no plan yet: the objects must be at rest and the position of the arm known"
    if below.current:
        return f"move {below.current} is under way"
    return f"no path yet for move {below.done + 1}"
