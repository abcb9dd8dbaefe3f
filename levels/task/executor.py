"""The executor of the task level: hands down a window of the plan and follows it to its end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from backplane.message import Message, MessageType, State
from levels.level import Executor, Input, LevelContext, Ports
from levels.messages import MOVE_STATUS, TASK_COMMAND, TASK_PLAN, TASK_STATUS, WINDOW, Error
from levels.task.program import read_program

ROUNDING_S = 1e-9
"""Ticks times the clock's period are not exact: a time just reached is not late."""


class TaskExecutor(Executor):
    """Reports the program done, or the error that ended it: refused, failed below, or late."""

    inputs: ClassVar[Mapping[str, Input]] = {
        "status": Input(MOVE_STATUS, "below.status"),
        "plan": Input(TASK_PLAN, "own.plan"),
        "last_status": Input(TASK_STATUS, "own.status"),
    }
    outputs: ClassVar[Mapping[str, MessageType]] = {"command": TASK_COMMAND, "status": TASK_STATUS}

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._actions = read_program(context.task, context.robot, context.scene).action
        self._started = False
        self._done = 0
        self._error = Error.NONE
        self._reason = ""

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Take up what is done below; hand down what comes next."""
        if not self._started:
            self._go_on(read.last_status.value)
        plan, below = read.plan.value, read.status.value
        if not self._error:
            self._follow(plan, below)
            self._keep_time(plan, tick)
        self._hand_down(plan, write.command)
        self._report(plan, write.status)

    def _go_on(self, last: Message) -> None:
        """Go on from the last status in the mailbox, after a restart of the board."""
        self._started = True
        self._done = last.moves_done
        self._error, self._reason = Error(last.error), last.reason

    def _follow(self, plan: Message, below: Message) -> None:
        if plan.error:
            self._error, self._reason = Error(plan.error), plan.reason
        elif plan.count:
            first = int(plan.moves["id"][0])
            self._done = min(max(self._done, below.done - first + 1), plan.count)
        if below.state == State.ERROR and self._done < plan.count:
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

    def _actions_done(self, plan: Message) -> int:
        if not plan.count:
            return 0
        return len(self._actions) if self._done == plan.count else int(plan.moves["action"][self._done])

    def _hand_down(self, plan: Message, command: Message) -> None:
        """Show the moves from the first one that is not done on; behind the last, the window stays."""
        if self._error or not plan.count:
            command.count = 0
            command.moves = np.zeros((), command.moves.dtype)
            return
        first = min(self._done, max(plan.count - WINDOW, 0))
        count = min(WINDOW, plan.count - first)
        command.moves[:count] = plan.moves[first : first + count]
        command.count = count
        command.id = int(plan.moves["id"][first + count - 1])

    def _report(self, plan: Message, status: Message) -> None:
        status.echo = plan.id
        status.state = self._state(plan)
        status.error, status.reason = self._error, self._reason
        status.action, status.actions = self._actions_done(plan), len(self._actions)
        status.moves_done, status.moves = self._done, plan.count

    def _state(self, plan: Message) -> State:
        if self._error:
            return State.ERROR
        if not self._actions:
            return State.IDLE
        return State.DONE if plan.count and self._done == plan.count else State.EXECUTING
