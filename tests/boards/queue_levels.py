"""Levels for tests of queues: one numbers its requests, the other checks that it gets each once and
in order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rack.backplane.message import Field, Message, command, status
from rack.levels.level import Executor, Input, LevelContext, Output, Planner, Ports, Reading

REQUEST = command("request", 1, Field("made_at", "i8", "tick", "release of the cycle that sent it"))
SENT = status(
    "sent",
    1,
    Field("sent", "i8", "1", "requests sent"),
    Field("refused", "i8", "1", "refused: queue full"),
)
TAKEN = status(
    "taken",
    1,
    Field("taken", "i8", "1", "requests taken"),
    Field("newest", "u4", "1", "id of the newest request taken"),
    Field("repeated", "i8", "1", "requests not newer than the one before"),
    Field("missing", "i8", "1", "ids between requests taken one after the other"),
)


def request_id(context: LevelContext, tick: int, number: int) -> int:
    """Return the id of the n-th request of a cycle: it does not depend on what the level
    remembers."""
    return 1 + tick // context.every * int(context.params["burst"]) + number


def count(requests: Reading, status: Message) -> None:
    """Check the ids of the requests taken, and count them."""
    for request in (*requests.earlier, requests.value) if requests.is_new else ():
        step = request.id - status.newest
        status.repeated += step <= 0
        status.missing += max(0, step - 1)
        status.newest = request.id
        status.taken += 1


class Asking(Executor):
    """Sends `burst` requests in every cycle before tick `until`."""

    outputs = {"status": SENT, "requests": Output(REQUEST, queued=True)}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Send the cycle's requests, and count those refused."""
        params: Mapping[str, Any] = self.context.params
        for number in range(params["burst"] if tick < params.get("until", 1 << 60) else 0):
            write.requests.id = request_id(self.context, tick, number)
            write.requests.made_at = tick
            if write.requests.send():
                write.status.sent += 1
            else:
                write.status.refused += 1


class Answering(Executor):
    """Takes at most `most` requests a cycle, and counts what is repeated or missing."""

    inputs = {"requests": Input(REQUEST, "above.requests"), "own": Input(TAKEN, "own.status")}
    outputs = {"status": TAKEN}

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._has_begun = False

    def room(self, port: str) -> int:
        return int(self.context.params.get("most", 1 << 30))

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        if not self._has_begun:
            self._has_begun = True
            if read.own.is_there:
                write.status.copy_from(read.own.value)
        count(read.requests, write.status)


class Steady(Executor):
    """Follows the plan of its planner, a queue, as a level that reads requests does."""

    inputs = {"plan": Input(REQUEST, "own.plan")}
    outputs = {"status": TAKEN}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        if read.plan.is_new:
            write.status.taken += 1 + len(read.plan.earlier)
            write.status.newest = read.plan.value.id


class Stepping(Planner):
    """Plans `burst` steps at a time, each a message of its own."""

    output = Output(REQUEST, queued=True)

    def wanted(self, read: Ports, tick: int) -> bool:
        return True

    def plan(self, read: Ports, write: Message, tick: int) -> None:
        """Queue the steps as far as there is room."""
        for _ in range(min(int(self.context.params["burst"]), write.room())):
            write.id += 1
            write.made_at = tick
            assert write.send(), "there was room"


class Filing(Planner):
    """Plans what it has taken: its slice is several cycles, in which requests wait."""

    inputs = {"requests": Input(REQUEST, "above.requests")}
    output = TAKEN

    def wanted(self, read: Ports, tick: int) -> bool:
        return bool(read.requests.is_new)

    def plan(self, read: Ports, write: Message, tick: int) -> None:
        count(read.requests, write)


class Filed(Executor):
    """Shows its planner's counts."""

    inputs = {"plan": Input(TAKEN, "own.plan")}
    outputs = {"status": TAKEN}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        write.status.copy_from(read.plan.value)
