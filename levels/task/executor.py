"""The executor of the task level: hands down a window of the plan and follows it to its end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from rack.backplane.message import Message, MessageType, State
from rack.levels.level import Executor, Input, LevelContext, Ports, Reading
from rack.levels.messages import MOVE_STATUS, TASK_COMMAND, TASK_PLAN, TASK_STATUS, Error
from rack.levels.operator import BELOW_LOST, HELD_FROM_ABOVE, OPERATOR_COMMAND, Commands, Goal, Operation, Orders
from rack.levels.tables import read_params
from rack.levels.task.detour import Detour
from rack.levels.task.params import TaskParams
from rack.levels.task.program import TaskConfig, read_program
from rack.levels.task.window import ShownWindow

ROUNDING_S = 1e-9
"""Ticks times the clock's period are not exact: a time just reached is not late."""


class TaskExecutor(Executor):
    """Reports the program done, or the error that ended it: refused, failed below, or late.

    An operator may hold it, or send the arm elsewhere between two of its moves.
    """

    inputs: ClassVar[Mapping[str, Input]] = {
        "status": Input(MOVE_STATUS, "below.status"),
        "plan": Input(TASK_PLAN, "own.plan"),
        "last_command": Input(TASK_COMMAND, "own.command"),
        "last_status": Input(TASK_STATUS, "own.status"),
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
    }
    outputs: ClassVar[Mapping[str, MessageType]] = {"command": TASK_COMMAND, "status": TASK_STATUS}
    commands: ClassVar[Commands] = {
        Operation.HOLD: (),
        Operation.RESUME: (),
        Operation.GOTO: (Goal.JOINTS, Goal.POSE, Goal.DIRECTION, Goal.HOME),
    }
    program = TaskConfig

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._actions = read_program(context.task, context.robot, context.scene).action
        self._orders = Orders(self.commands)
        self._window = ShownWindow()
        self._detour = Detour(context.robot)
        self._started = False
        self._done = 0
        self._error = Error.NONE
        self._reason = ""
        self._stalled_s = read_params(TaskParams, context.params).stalled_s
        self._mark: tuple[float, ...] = ()  # all that changes where anything moves
        self._moved_at = 0

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Take up what is done below, and what an operator says; hand down what comes next."""
        if not self._started:
            self._go_on(read)
        self._orders.take(read.operator, lambda command: self._judge(command, read.last_status.value.order))
        plan, below = read.plan.value, read.status.value
        if not self._error:
            self._follow(plan, below)
            self._keep_time(plan, tick)
        self._done = self._detour.step(self._orders, plan, self._done, below, self._window)
        kept_from = self._kept_from(read.status)
        if self._state(plan) == State.EXECUTING:
            self._keep_going(read, kept_from, tick)
        self._hand_down(plan, write.command)
        self._report(plan, kept_from, write.status)
        self._answer(below, write)

    def _go_on(self, read: Ports) -> None:
        """Go on from the last command and status in the mailboxes, after a restart of the board."""
        self._started = True
        last = read.last_status.value
        self._done = last.moves_done
        self._error, self._reason = Error(last.error), last.reason
        if read.last_status.is_there and read.last_command.is_there:
            before = (last.detour or last.first + self._done) - 1
            self._window = ShownWindow(last.first, read.last_command.value.id, before)
            self._detour = Detour(self.context.robot, last.detour)

    def _judge(self, command: Message, answered: int) -> None:
        """Take up a goto, or one that this board had answered when it died, or refuse it."""
        if self._orders.standing is Operation.GOTO:
            self._detour.begin(command, self._orders, command.id > answered)

    def _follow(self, plan: Message, below: Message) -> None:
        if plan.error:
            self._error, self._reason = Error(plan.error), plan.reason
        elif plan.count and not self._detour.move:
            self._done = min(max(self._done, self._window.done(below)), plan.count)
        failed = below.state == State.ERROR and below.done >= self._window.before
        if failed and not self._detour.move and self._done < plan.count:
            action = int(plan.moves["action"][self._done])
            self._error, self._reason = Error(below.error), f"action {action}: {below.reason}"

    def _keep_time(self, plan: Message, tick: int) -> None:
        """Fail when an action that has a time is not done by it."""
        now_s, done = tick * self.context.tick_s, self._actions_done(plan)
        for k in range(done, len(self._actions)):
            by_s = self._actions[k].by
            if by_s is not None and now_s > by_s + ROUNDING_S and not self._error:
                reason = f"action {k}, {self._actions[k]}, was not done by {by_s:g} s"
                self._error, self._reason = Error.TOO_LATE, reason

    def _kept_from(self, below: Reading) -> str:
        """Return who or what keeps the level from its work, and what ends that; empty: nothing does."""
        orders = self._orders
        if orders.standing is Operation.GOTO:
            return self._detour.described(orders)
        if orders.standing is not Operation.NONE:
            return orders.keeps(self.context.board)
        if below.is_lost:
            return BELOW_LOST
        is_held = below.value.state == State.HOLDING and below.value.reason != HELD_FROM_ABOVE
        return str(below.value.reason) if is_held else ""

    def _keep_going(self, read: Ports, kept_from: str, tick: int) -> None:
        """Fail where nothing has moved for too long, unless an operator wants it so."""
        plan, below = read.plan.value, read.status.value
        mark = (plan.id, self._done, below.done, below.planned, below.current, below.progress, self._detour.move)
        operated = below.operated or self._orders.standing is not Operation.NONE
        if operated or mark != self._mark:
            self._mark, self._moved_at = mark, tick
        elif (tick - self._moved_at) * self.context.tick_s > self._stalled_s:
            self._error = Error.STALLED
            self._reason = f"nothing has moved for {self._stalled_s:g} s: {kept_from or _awaited(plan, below)}"

    def _actions_done(self, plan: Message) -> int:
        if not plan.count:
            return 0
        return len(self._actions) if self._done == plan.count else int(plan.moves["action"][self._done])

    def _hand_down(self, plan: Message, command: Message) -> None:
        """Show the program's next moves, or the one that an operator wants."""
        detour, window = self._detour, self._window
        if self._error or not (detour.is_known if detour.move else plan.count):
            window.show_none(command)
        elif detour.move:
            window.show_one(detour.as_move(self._actions_done(plan)), command)
        else:
            window.show(plan, self._done, command, plan.count if detour.until is None else detour.until)

    def _report(self, plan: Message, kept_from: str, status: Message) -> None:
        status.echo = plan.id
        status.state = self._state(plan)
        if kept_from and status.state == State.EXECUTING:
            status.state = State.HOLDING
        status.error = self._error
        status.reason = self._reason if self._error else kept_from if status.state == State.HOLDING else ""
        status.action, status.actions = self._actions_done(plan), len(self._actions)
        status.moves_done, status.moves = self._done, plan.count
        status.first, status.detour = self._window.first, self._detour.move

    def _answer(self, below: Message, write: Ports) -> None:
        """Hold where an operator says so, answer, and hand down what this cycle rests on."""
        orders = self._orders
        write.command.hold = orders.standing is Operation.HOLD or self._detour.holds
        write.command.operator = orders.rests_on(0)
        if orders.standing is Operation.HOLD and below.resting and below.operator >= orders.basis:
            orders.done()
        orders.report(write.status)

    def _state(self, plan: Message) -> State:
        if self._error:
            return State.ERROR
        if not self._actions:
            return State.IDLE
        return State.DONE if plan.count and self._done == plan.count else State.EXECUTING


def _awaited(plan: Message, below: Message) -> str:
    """Return what a task waits for that nobody holds."""
    if not plan.id:
        return "no plan; do all objects rest, is the arm seen?"
    return f"move {below.current} is under way" if below.current else f"no path yet for move {below.done + 1}"
