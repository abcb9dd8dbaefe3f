"""A message, written and read: every protocol of ours next to other ways of the same machine.

Each turn numbers a message, sends it, and lets every reader receive it into fields of its own.
Filling and taking the fields costs every contestant the same, and is left out. All happens in one
process: what is compared is the work, not the wake-up of another process.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import count, islice
from typing import NamedTuple

import numpy as np

from rack.backplane.layout import PROTOCOLS, InterruptSpec, Layout, MailboxSpec, Protocol, TaskSpec
from rack.backplane.mailbox.interrupt import open_inbox
from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.message import AnyMessage, Command, field
from rack.backplane.segment import Segment, unlink
from rack.backplane.watch.alarms import AlarmWriter
from rack.backplane.watch.silence_watch import ReadingTask
from rack.backplane.watch.watched_reader import watched
from rack.boards.config.layout import field_specs
from rack.boards.faults.bounds import counting
from rack.boards.run.port_tables import Line, ReadTable, WriteTable, can_read, can_write
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.harness import (
    Absent,
    Comparison,
    Sample,
    absent_package,
    interleaved,
)
from rack.tools.lab.benches.transports import PEERS, Peer, Transport

SIZES = {"64 B": 64, "200 B": 200, "2 kB": 2048, "16 kB": 16384}
"""Bytes of a message: a serial, and three arrays of numbers."""
READERS = (1, 4)
BATCH_S = 0.001
"""About how long one measurement takes: many exchanges, and their mean. Short: most end without an
interruption."""
CASE_S = 5.0
"""About how long a case takes."""


class Bench(Command, version=1):
    """The message whose transport is measured."""

    position: np.ndarray = field(unit="rad", doc="joint positions", shape="joints")
    velocity: np.ndarray = field(unit="rad/s", doc="joint velocities", shape="joints")
    torque: np.ndarray = field(unit="N m", doc="joint torques", shape="rest")


class Case(NamedTuple):
    """A message size and a number of readers."""

    size: str
    readers: int

    @property
    def name(self) -> str:
        """The case, in words."""
        return f"{self.size}, {counting(self.readers, 'reader')}"

    @property
    def lengths(self) -> dict[str, int]:
        """Lengths of the arrays that fill the message."""
        numbers = SIZES[self.size] // 8 - 1
        return {"joints": numbers // 3, "rest": numbers - 2 * (numbers // 3)}


CASES = tuple(Case(size, readers) for readers in READERS for size in SIZES)


def measure(cases: Sequence[Case], rounds: int, progress: Progress) -> Comparison:
    """Measure every contestant that is installed in every case; the baseline of a case is its best
    peer.
    """
    missing = {peer.name: absent_package(peer.name, peer.module) for peer in PEERS}
    present = [peer for peer in PEERS if not missing[peer.name]]
    progress.total(CASE_S * len(cases))
    samples: list[Sample] = []
    for case in cases:
        progress.begin(case.name)
        samples += _measure_case(case, present, rounds)
        progress.end(CASE_S)
    absent = tuple(one for each in missing.values() for one in each)
    return compare(samples, absent)


def compare(samples: Sequence[Sample], absent: tuple[Absent, ...]) -> Comparison:
    """Return the comparison of these samples with the best peer of each case."""
    peers = {peer.name for peer in PEERS}
    baselines = {}
    for case in dict.fromkeys(sample.case for sample in samples):
        own = [sample for sample in samples if sample.case == case and sample.who in peers]
        if own:
            baselines[case] = min(own, key=lambda sample: sample.median).who
    title = "A message written and read; ratio to the best peer of the case"
    return Comparison("mailbox", title, tuple(samples), baselines, absent)


def _measure_case(case: Case, peers: Sequence[Peer], rounds: int) -> list[Sample]:
    dtype = Bench.message_type.dtype(case.lengths)
    with ExitStack() as stack:
        transports: dict[str, Transport] = {
            p: stack.enter_context(_mailbox(p, case)) for p in PROTOCOLS
        }
        transports |= {
            peer.name: stack.enter_context(peer.opened(dtype, case.readers)) for peer in peers
        }
        turns = {
            name: exchange(name, transport, case.lengths) for name, transport in transports.items()
        }
        found = interleaved(turns, rounds)
    return [Sample(case.name, name, tuple(values), "us") for name, values in found.items()]


def exchange(name: str, transport: Transport, lengths: dict[str, int]) -> Callable[[], float]:
    """Return a function that makes many exchanges through a transport, and returns the us that each
    took. Raises `Failure` if a reader receives another message than the one sent.
    """
    message, send, readers = transport
    for key, length in (("position", "joints"), ("velocity", "joints"), ("torque", "rest")):
        setattr(message, key, np.linspace(-9.0, 9.0, lengths[length]))
    ticks = count(1)

    def measure_us(calls: int) -> float:
        start_ns = time.perf_counter_ns()
        for tick in islice(ticks, calls):
            message.id = tick
            send(tick)
            for read in readers:
                read(tick)
        return (time.perf_counter_ns() - start_ns) / calls * 1e-3

    measure_us(20)
    message.id = tick = next(ticks)
    message.torque[:] = tick
    sent = bytes(message.raw)
    send(tick)
    if any(bytes(read(tick).raw) != sent for read in readers):
        raise Failure(f"{name}: a reader received another message than the one sent")
    return partial(measure_us, max(10, int(BATCH_S * 1e6 / measure_us(20))))


@contextmanager
def _mailbox(protocol: Protocol, case: Case) -> Iterator[Transport]:
    """Give a mailbox of ours, in a segment of its own."""
    rack = f"bench-{os.getpid()}-{protocol}"
    layout = _layout(rack, protocol, case)
    with ExitStack() as names:
        # Before they exist: an interrupt may come at any time.
        names.callback(unlink, rack)
        segment = Segment.create(layout, "")
        (box,) = layout.mailboxes
        writer = open_writer(segment, box.name)
        readers = [_reading(segment, box, task) for task in box.readers]
    # Open, it needs no name: nothing is left even if this process is killed.
    send = WriteTable([(writer, ())]).write if can_write(writer) else writer.write
    yield Transport(writer.message, send, readers)


def _reading(segment: Segment, box: MailboxSpec, task: str) -> Callable[[int], AnyMessage]:
    """Return a function that reads as a board does; without its checks on the writer, where no
    machine code makes them.
    """
    inbox = open_inbox(segment, task)
    found = watched(segment, box.name, AlarmWriter(segment, task), ReadingTask(inbox))
    read = found.reader.read
    delay = box.delay
    message = found.reader.message
    line = Line({}, box.name, found.read, found)
    if can_read(line):
        read_table = ReadTable([line]).read

        def take_from_table(tick: int) -> AnyMessage:
            read_table(tick + delay)
            return message

        return take_from_table

    def take(tick: int) -> AnyMessage:
        return read(tick + delay).message

    return take


def _layout(rack: str, protocol: Protocol, case: Case) -> Layout:
    readers = tuple(f"reader{number}" for number in range(case.readers))
    tasks = tuple(
        TaskSpec(n, n, "executor", 2 + i, 0, 0, 1, 1, 4) for i, n in enumerate(("writer", *readers))
    )
    interrupt = None
    if protocol == "interrupt":
        # Each reader is alone with its inbox: every message is served before the next one is sent.
        interrupt = InterruptSpec(
            1_000_000, 50_000, 16, due=1, ahead=1, slots=tuple(task.slot for task in tasks[1:])
        )
    box = MailboxSpec(
        name="writer.command",
        writer="writer",
        readers=readers,
        protocol=protocol,
        every=1,
        delay=1,
        depth=64,
        message=Bench.message_type.name,
        version=Bench.message_type.version,
        size=Bench.message_type.dtype(case.lengths).itemsize,
        fields=field_specs(Bench.message_type, case.lengths),
        interrupt=interrupt,
    )
    return Layout(rack, 2_500_000, tasks, (box,))
