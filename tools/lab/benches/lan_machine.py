"""What runs on each machine of `rack bench lan`: one end, which exchanges messages at a rate and
measures.

It is started with a pipe, through which it gets a `LanTask`. It answers with a `LanFound` when it
sees those that it exchanges messages with, and then to every `LanWindow`, until it is killed; the
coordinator also sends a `LanNotice` of each change. In a window each machine has a grid of its own
phase, as racks have.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing.connection import Connection
from struct import Struct
from typing import NamedTuple

from rack.backplane.process import die_with_parent, pin, set_priority
from rack.tools.lab.benches.lan_ends import ORDER_BYTES, STATUS_BYTES, End, LanTask

TLS = "rack, TLS"
TCP = "rack, TCP"
ENDS = {
    TLS: "rack.tools.lab.benches.lan_link:RackEnd",
    TCP: "rack.tools.lab.benches.lan_link:RackEnd",
    "UDP": "rack.tools.lab.benches.lan_ends:UdpEnd",
    "cyclonedds": "rack.tools.lab.benches.lan_dds:DdsEnd",
}
FIND_S = 30.0
"""Longest time that machines may take to find each other."""
ANSWER_S = 1.0
"""Longest wait for the last answers of a window."""
_HEAD = Struct("<qq")
"""Head of a message: its number, and when it was sent, CLOCK_MONOTONIC, ns."""


@dataclass(frozen=True)
class LanWindow:
    """A measurement: cycles on a grid of `period_ns` from `start_ns` on, CLOCK_MONOTONIC."""

    start_ns: int
    period_ns: int
    cycles: int


@dataclass
class LanFound:
    """What one machine has found in a window: ages or round trips, us; messages that never came;
    its processor time."""

    us: list[float] = field(default_factory=list)
    missing: int = 0
    processor_us: float = 0.0


class LanNotice(NamedTuple):
    """A machine has come, or gone: when the coordinator saw it, CLOCK_MONOTONIC."""

    machine: int
    is_there: bool
    seen_ns: int


class Machine:
    """The process of one machine; `pipe` leads to who started it."""

    def __init__(self, task: LanTask, pipe: Connection) -> None:
        self._pipe = pipe
        self._sending = threading.Lock()  # the end's threads send, too
        self._task = task
        self._seen: set[int] = set()
        self._all_there = threading.Event()
        self._answered = threading.Event()
        self._awaited = 0
        self._round_trips: list[float] = []
        self._numbers: dict[int, int] = {}
        self._sent = 0
        module, _, name = ENDS[task.who].partition(":")
        kind: type[End] = getattr(import_module(module), name)
        echo = None
        if task.echoes:
            echo = self._count if task.is_coordinator else self._answer
        self._size = ORDER_BYTES if task.is_coordinator else STATUS_BYTES
        self._end = kind(task, self._notice, echo)

    def find(self) -> None:
        """Wait until all others are there. Raises `TimeoutError`."""
        if not self._all_there.wait(FIND_S):
            missing = sorted(set(self._task.others) - self._seen)
            raise TimeoutError(
                f"machine {self._task.machine}: {missing} not found within {FIND_S:g} s"
            )

    def _notice(self, machine: int, is_there: bool) -> None:
        """Note that another machine has come or gone; the coordinator says so."""
        if is_there:
            self._seen.add(machine)
        if self._task.is_coordinator:
            self.answer(LanNotice(machine, is_there, time.monotonic_ns()))
        if len(self._seen) == len(self._task.others):
            self._all_there.set()

    def answer(self, found: LanFound | LanNotice) -> None:
        """Send what was found."""
        with self._sending:
            self._pipe.send(found)

    def measure(self, window: LanWindow) -> LanFound:
        """Run a window."""
        before_ns = time.process_time_ns()
        if not self._task.echoes:
            found = self._cycle(window)
        else:
            found = self._ask(window) if self._task.is_coordinator else LanFound()
        # Of all threads.
        found.processor_us = (time.process_time_ns() - before_ns) * 1e-3
        return found

    def _cycle(self, window: LanWindow) -> LanFound:
        """Take in each cycle what has come, and send: ages are those of messages when a cycle takes
        them."""
        found = LanFound()
        # The coordinator at 0, the others spread over its period.
        shift = self._task.machine * window.period_ns // len(self._task.addresses)
        for _ in _grid(window, shift):
            now = time.monotonic_ns()
            for machine, content in self._end.taken():
                number, sent_ns = _HEAD.unpack_from(content)
                found.missing += number - self._numbers.get(machine, number - 1) - 1
                self._numbers[machine] = number
                # The last ones of the window before this waited for it.
                if sent_ns >= window.start_ns:
                    found.us.append((now - sent_ns) * 1e-3)
            self._sent += 1
            for machine in self._task.others:
                self._end.send(machine, _HEAD.pack(self._sent, now).ljust(self._size, b"\0"))
        return found

    def _ask(self, window: LanWindow) -> LanFound:
        """Send an order to all in each cycle; each is answered at once."""
        self._round_trips.clear()
        self._awaited = window.cycles * len(self._task.others)
        self._answered.clear()
        for cycle in _grid(window, 0):
            for machine in self._task.others:
                self._end.send(
                    machine, _HEAD.pack(cycle, time.monotonic_ns()).ljust(self._size, b"\0")
                )
        self._answered.wait(ANSWER_S)
        return LanFound(list(self._round_trips), self._awaited - len(self._round_trips))

    def _count(self, machine: int, content: bytes) -> None:
        now = time.monotonic_ns()
        self._round_trips.append((now - _HEAD.unpack_from(content)[1]) * 1e-3)
        if len(self._round_trips) == self._awaited:
            self._answered.set()

    def _answer(self, machine: int, content: bytes) -> None:
        self._end.send(machine, content[: self._size])


def _grid(window: LanWindow, shift_ns: int) -> Iterator[int]:
    """Yield the number of each cycle at its grid point; one that has passed is skipped."""
    cycle = 0
    while cycle < window.cycles:
        due = window.start_ns + shift_ns + cycle * window.period_ns
        if (left := due - time.monotonic_ns()) > 0:
            time.sleep(left * 1e-9)
        yield cycle
        cycle += 1 + max(0, time.monotonic_ns() - due) // window.period_ns


def main() -> None:
    """Run the task that comes through the inherited pipe."""
    die_with_parent(os.getppid())
    with Connection(int(sys.argv[1])) as pipe:
        task: LanTask = pipe.recv()
        # Before the end starts its threads, which have core and priority of this one: as on a
        # rack's adapter board.
        cores = sorted(os.sched_getaffinity(0))
        pin(cores[task.machine % len(cores)])
        set_priority(task.priority)
        machine = Machine(task, pipe)
        machine.find()
        machine.answer(LanFound())
        while True:
            machine.answer(machine.measure(pipe.recv()))
