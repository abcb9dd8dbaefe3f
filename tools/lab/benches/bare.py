"""A rack's work without the rack: the same `process` and `plan` calls in one process, one after
another.

Levels, ports and delays are those of the resolved config; a message becomes visible by ticks alone,
as under protocol time-slice, so every level reads what it reads in a rack in lockstep, and does the
same. No clock, no shared memory, no checks and no trace: this is the limit that a rack can
approach, but not pass on one processor.
"""

from __future__ import annotations

import gc
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.mailbox.slots import message_dtype
from rack.backplane.message import Message
from rack.boards.classes import find_class
from rack.boards.wiring import TaskWiring
from rack.levels.level import Executor, Planner, Ports, Reading, Verdict
from rack.tools.console.answer import Failure


@dataclass(frozen=True)
class BareRun:
    """A finished run. `processor_s` is the time of its ticks.

    `last` is the newest message of each mailbox that was visible before the end, `serials` its
    number; without one, a mailbox is left out.
    """

    ticks: int
    processor_s: float
    serials: Mapping[str, int]
    last: Mapping[str, np.ndarray]


class Post:
    """One mailbox: `message` to fill, and the messages written so far that a reader may still
    need."""

    def __init__(self, spec: MailboxSpec) -> None:
        self.spec = spec
        self.dtype = message_dtype(spec.fields, spec.size)
        self.message = Message(self.dtype)
        self.serial = 0
        # All that are not visible yet, and the newest that is.
        self.kept: deque[tuple[int, int, bytes]] = deque(maxlen=spec.delay // spec.every + 2)

    def write(self, tick: int, cycle: int) -> None:
        """Write the message in the cycle of `cycle` ticks released at `tick`, if this is one that
        writes it."""
        if not (tick + cycle - self.spec.phase) % self.spec.every:
            self.serial += 1
            self.kept.append((tick + self.spec.delay, self.serial, bytes(self.message.raw)))

    def newest(self, tick: int) -> tuple[int, bytes] | None:
        """Return serial and bytes of the newest message visible at `tick`; None: there is none."""
        for visible_at, serial, data in reversed(self.kept):
            if visible_at <= tick:
                return serial, data
        return None


class PostReader:
    """One reader of a mailbox."""

    def __init__(self, post: Post) -> None:
        self._post = post
        self._serial = 0
        self._message = Message(post.dtype)
        self._readings = {verdict: Reading(self._message, verdict) for verdict in Verdict}

    def read(self, tick: int) -> Reading:
        """Return the newest message visible at `tick`, and its verdict."""
        newest = self._post.newest(tick)
        if newest is None:
            return self._readings[Verdict.NONE]
        serial, data = newest
        if serial == self._serial:
            return self._readings[Verdict.OLD]
        self._serial = serial
        self._message.raw[:] = data
        return self._readings[Verdict.NEW]


class BareTask:
    """An executor or a planner with its ports."""

    def __init__(
        self, layout: Layout, wiring: TaskWiring, posts: Mapping[str, Post], ticks: int
    ) -> None:
        self.spec = layout.task(wiring.task)
        self._ticks = ticks
        self._values = Ports()
        # Where each reading goes: the ports themselves, or the dict of a port that reads many
        # mailboxes.
        self._readers: list[tuple[dict[str, Reading], str, Callable[[int], Reading]]] = []
        for port, source in wiring.inputs.items():
            if isinstance(source, str):
                self._add(self._values.__dict__, port, posts[source])
            else:
                by_board: dict[str, Reading] = {}
                setattr(self._values, port, by_board)
                for board, mailbox in source.items():
                    self._add(by_board, board, posts[mailbox])
        self._posts = [posts[name] for name in wiring.outputs.values()]
        self._messages = Ports(
            **{port: posts[name].message for port, name in wiring.outputs.items()}
        )
        self._busy_until = 0
        kind: type[Executor] | type[Planner] = find_class(
            wiring.target,
            Executor if self.spec.role == "executor" else Planner,
        )
        kind.preload()
        self.level = kind(wiring.context)
        self.cycle = self._execute if isinstance(self.level, Executor) else self._plan

    def _add(self, values: dict[str, Reading], key: str, post: Post) -> None:
        reader = PostReader(post)
        values[key] = reader.read(-1)
        self._readers.append((values, key, reader.read))

    def _execute(self, tick: int) -> None:
        self._read(tick)
        assert isinstance(self.level, Executor), "a planner plans"
        self.level.process(self._values, self._messages, tick)
        self.level.findings.clear()
        self._write(tick)

    def _plan(self, tick: int) -> None:
        if tick < self._busy_until:
            return
        self._read(tick)
        assert isinstance(self.level, Planner), "an executor executes"
        if self.level.wanted(self._values, tick):
            self._busy_until = tick + self.spec.every * self.spec.within_cycles
            # A rack does not wait for a plan that comes after its end.
            if self._busy_until < self._ticks:
                self.level.plan(self._values, self._messages.plan, tick)
                self._write(tick)

    def _read(self, tick: int) -> None:
        for values, key, read in self._readers:
            values[key] = read(tick)

    def _write(self, tick: int) -> None:
        for post in self._posts:
            post.write(tick, self.spec.every)


def run_bare(layout: Layout, wirings: Sequence[TaskWiring], ticks: int) -> BareRun:
    """Run every level of a rack for so many ticks; nobody commands it, and no fault strikes it.

    Raises `Failure` for a rack with a queue, whose writer depends on its reader: without mailboxes
    there is none; and for one with an exchange or with interrupts, which belong to the board.
    """
    if exchanged := [spec.name for spec in layout.mailboxes if spec.exchanges]:
        raise Failure(
            f"{', '.join(exchanged)}: read at a rate of its own; only racks without any run without"
            " boards"
        )
    if queues := [spec.name for spec in layout.mailboxes if spec.capacity]:
        raise Failure(f"{', '.join(queues)}: a queue; only racks without any run without mailboxes")
    if served := [spec.name for spec in layout.mailboxes if spec.interrupt is not None]:
        raise Failure(
            f"{', '.join(served)}: interrupts its readers; only racks without any run without"
            " boards"
        )
    posts = {spec.name: Post(spec) for spec in layout.mailboxes}
    tasks = [BareTask(layout, wiring, posts, ticks) for wiring in wirings]
    try:
        for task in tasks:
            task.level.self_test()
        cycles = [(*task.spec.grid, task.cycle) for task in tasks]
        with _undisturbed():
            start_ns = time.process_time_ns()
            _run(cycles, ticks)
            processor_s = (time.process_time_ns() - start_ns) * 1e-9
    finally:
        for task in tasks:
            task.level.close()
    found = {
        name: newest
        for name, post in posts.items()
        if (newest := post.newest(ticks - 1)) is not None
    }
    return BareRun(
        ticks=ticks,
        processor_s=processor_s,
        serials={name: serial for name, (serial, _) in found.items()},
        last={name: np.frombuffer(data, posts[name].dtype)[0] for name, (_, data) in found.items()},
    )


def _run(cycles: Sequence[tuple[int, int, Callable[[int], None]]], ticks: int) -> None:
    for tick in range(ticks):
        for every, phase, cycle in cycles:
            if tick % every == phase:
                cycle(tick)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Collect no garbage meanwhile, as in a board."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
