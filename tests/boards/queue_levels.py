"""Levels for tests of queues: one numbers its requests, the other checks that it gets each once and
in order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rack.backplane.message import Command, Message, Status, field
from rack.levels.level import Executor, Input, LevelContext, Output, Planner, QueuedOutput, Reading


class Request(Command, version=1):
    made_at: int = field(unit="tick", doc="release of the cycle that sent it")


class Sent(Status, version=1):
    sent: int = field(unit="1", doc="requests sent")
    refused: int = field(unit="1", doc="refused: queue full")


class Taken(Status, version=1):
    taken: int = field(unit="1", doc="requests taken")
    newest: int = field("u4", unit="1", doc="id of the newest request taken")
    repeated: int = field(unit="1", doc="requests not newer than the one before")
    missing: int = field(unit="1", doc="ids between requests taken one after the other")


def count(requests: Reading, status: Message) -> None:
    """Check the ids of the requests taken, and count them."""
    for request in (*requests.earlier, requests.message) if requests.is_new else ():
        step = request.id - status.newest
        status.repeated += step <= 0
        status.missing += max(0, step - 1)
        status.newest = request.id
        status.taken += 1


class Asking(Executor):
    """Sends `burst` requests in every cycle before tick `until`."""

    status = Output(Sent)
    requests = QueuedOutput(Request)

    def process(self, tick: int) -> None:
        """Send the cycle's requests, and count those refused."""
        params: Mapping[str, Any] = self.context.params
        # The ids do not depend on what the level remembers.
        first = 1 + tick // self.context.every * int(params["burst"])
        for number in range(params["burst"] if tick < params.get("until", 1 << 60) else 0):
            self.requests.message.id = first + number
            self.requests.message.made_at = tick
            if self.requests.send():
                self.status.sent += 1
            else:
                self.status.refused += 1


class Answering(Executor):
    """Takes at most `most` requests a cycle, and counts what is repeated or missing."""

    requests = Input(Request, "above.requests")
    own = Input(Taken, "own.status")
    status = Output(Taken)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._has_begun = False

    def max_messages(self, port: str) -> int:
        return int(self.context.params.get("most", 1 << 30))

    def process(self, tick: int) -> None:
        if not self._has_begun:
            self._has_begun = True
            if self.own.has_message:
                self.status.copy_from(self.own.message)
        count(self.requests, self.status)


class Steady(Executor):
    """Follows the plan of its planner, a queue, as a level that reads requests does."""

    plan = Input(Request, "own.plan")
    status = Output(Taken)

    def process(self, tick: int) -> None:
        if self.plan.is_new:
            self.status.taken += 1 + len(self.plan.earlier)
            self.status.newest = self.plan.message.id


class Stepping(Planner):
    """Plans `burst` steps at a time, each a message of its own."""

    output = QueuedOutput(Request)

    def wanted(self, tick: int) -> bool:
        return True

    def plan(self, tick: int) -> None:
        """Queue the steps as far as there is room."""
        for _ in range(min(int(self.context.params["burst"]), self.output.room())):
            self.output.message.id += 1
            self.output.message.made_at = tick
            assert self.output.send(), "there was room"


class Filing(Planner):
    """Plans what it has taken: its slice is several cycles, in which requests wait."""

    requests = Input(Request, "above.requests")
    output = Output(Taken)

    def wanted(self, tick: int) -> bool:
        return bool(self.requests.is_new)

    def plan(self, tick: int) -> None:
        count(self.requests, self.output)


class Filed(Executor):
    """Shows its planner's counts."""

    plan = Input(Taken, "own.plan")
    status = Output(Taken)

    def process(self, tick: int) -> None:
        self.status.copy_from(self.plan.message)
