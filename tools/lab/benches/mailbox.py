"""Time to write and read a message, for the protocols of rack and for other transports.

In each exchange a message gets a number and is sent, and every reader receives it into local
fields. Filling and reading the fields costs the same for every contestant and is not measured. All
of this happens in one process: the bench compares the work, not the wake-up of another process.
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
from rack.backplane.segment import Segment, unlink_segment
from rack.backplane.watch.alarms import AlarmWriter
from rack.backplane.watch.silence_watch import ReadingTask
from rack.backplane.watch.watched_reader import open_watched
from rack.boards.config.layout import build_field_specs
from rack.boards.exchange import InputMailbox
from rack.boards.faults.bounds import format_count
from rack.boards.run.port_tables import ReadTable, WriteTable, can_read, can_write
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.harness import (
    Absent,
    Comparison,
    Sample,
    call_interleaved,
    find_missing_package,
)
from rack.tools.lab.benches.transports import PEERS, Peer, Transport

SIZE_BYTES = {"64 B": 64, "200 B": 200, "2 kB": 2048, "16 kB": 16384}
"""Message sizes in bytes. A message has a serial and three arrays of numbers."""
READERS = (1, 4)
BATCH_S = 0.001
"""Approximate time of one measurement, which is the mean of many exchanges, s.

It is short, so that most measurements end without an interruption.
"""
CASE_S = 5.0
"""Approximate time of a case, s."""


class BenchMessage(Command, version=1):
    """Message whose transport is measured."""

    position: np.ndarray = field(unit="rad", doc="joint positions", shape="joints")
    velocity: np.ndarray = field(unit="rad/s", doc="joint velocities", shape="joints")
    torque: np.ndarray = field(unit="N m", doc="joint torques", shape="rest")


class Case(NamedTuple):
    """A message size and a number of readers."""

    size: str
    readers: int

    @property
    def name(self) -> str:
        """Human-readable name of the case."""
        return f"{self.size}, {format_count(self.readers, 'reader')}"

    @property
    def lengths(self) -> dict[str, int]:
        """Lengths of the message's arrays, chosen to give the message its size."""
        numbers = SIZE_BYTES[self.size] // 8 - 1
        return {"joints": numbers // 3, "rest": numbers - 2 * (numbers // 3)}


CASES = tuple(Case(size, readers) for readers in READERS for size in SIZE_BYTES)


def measure_mailboxes(cases: Sequence[Case], rounds: int, progress: Progress) -> Comparison:
    """Measure every installed contestant in every case.

    Args:
        cases: Message sizes and numbers of readers.
        rounds: Number of measurements of each contestant.
        progress: Shows each case.

    Returns:
        Comparison with the best peer of each case.
    """
    absentees = {peer.name: find_missing_package(peer.name, peer.module) for peer in PEERS}
    present = [peer for peer in PEERS if not absentees[peer.name]]
    progress.set_total(CASE_S * len(cases))
    samples: list[Sample] = []
    for case in cases:
        progress.begin_run(case.name)
        samples += _measure_case(case, present, rounds)
        progress.end_run(CASE_S)
    absent = tuple(absentee for each in absentees.values() for absentee in each)
    return build_comparison(samples, absent)


def build_comparison(samples: Sequence[Sample], absent: tuple[Absent, ...]) -> Comparison:
    """Compare samples with the best peer of each case."""
    peers = {peer.name for peer in PEERS}
    baselines = {}
    for case in dict.fromkeys(sample.case for sample in samples):
        peer_samples = [sample for sample in samples if sample.case == case and sample.who in peers]
        if peer_samples:
            baselines[case] = min(peer_samples, key=lambda sample: sample.median).who
    return Comparison(
        "mailbox",
        "A message written and read; ratio to the best peer of the case",
        tuple(samples),
        baselines,
        absent,
    )


def _measure_case(case: Case, peers: Sequence[Peer], rounds: int) -> list[Sample]:
    """Measure all contestants in one case."""
    dtype = BenchMessage.message_type.build_dtype(case.lengths)
    with ExitStack() as stack:
        transports: dict[str, Transport] = {
            p: stack.enter_context(_open_mailbox(p, case)) for p in PROTOCOLS
        }
        transports |= {
            peer.name: stack.enter_context(peer.open_transport(dtype, case.readers))
            for peer in peers
        }
        exchanges = {
            name: build_exchange(name, transport, case.lengths)
            for name, transport in transports.items()
        }
        times_us = call_interleaved(exchanges, rounds)
    return [Sample(case.name, name, tuple(values), "us") for name, values in times_us.items()]


def build_exchange(name: str, transport: Transport, lengths: dict[str, int]) -> Callable[[], float]:
    """Build a function that makes many exchanges and returns the mean time of one, in us.

    Args:
        name: Name of the contestant.
        transport: Transport to use.
        lengths: Lengths of the message's arrays.

    Raises:
        Failure: If a reader receives a message other than the one that was sent.
    """
    message, send, readers = transport
    for key, length in (("position", "joints"), ("velocity", "joints"), ("torque", "rest")):
        setattr(message, key, np.linspace(-9.0, 9.0, lengths[length]))
    ticks = count(1)

    def measure_us(calls: int) -> float:
        """Return the mean time, in us, of `calls` exchanges."""
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
def _open_mailbox(protocol: Protocol, case: Case) -> Iterator[Transport]:
    """Open a mailbox of the backplane in a separate segment."""
    rack = f"bench-{os.getpid()}-{protocol}"
    layout = _build_layout(rack, protocol, case)
    with ExitStack() as names:
        # Register the clean-up before the names exist, because an interrupt may come at any time.
        names.callback(unlink_segment, rack)
        segment = Segment.create(layout, "")
        (box,) = layout.mailboxes
        writer = open_writer(segment, box.name)
        readers = [_build_reader(segment, box, task) for task in box.readers]
    # An open segment needs no name, and without a name nothing remains if this process is killed.
    send = WriteTable([(writer, ())]).write if can_write(writer) else writer.write
    yield Transport(writer.message, send, readers)


def _build_reader(segment: Segment, box: MailboxSpec, task: str) -> Callable[[int], AnyMessage]:
    """Build a function that reads a mailbox as a board does.

    If compiled code cannot read the mailbox, the checks on the writer are left out.
    """
    inbox = open_inbox(segment, task)
    watched_reader = open_watched(segment, box.name, AlarmWriter(segment, task), ReadingTask(inbox))
    read = watched_reader.reader.read
    delay = box.delay
    message = watched_reader.reader.message
    line = InputMailbox({}, box.name, watched_reader)
    if can_read(line):
        read_table = ReadTable([line]).read

        def read_by_table(tick: int) -> AnyMessage:
            """Read the mailbox through a `ReadTable`."""
            read_table(tick + delay)
            return message

        return read_by_table

    def read_message(tick: int) -> AnyMessage:
        """Read the mailbox directly, without checks on its writer."""
        return read(tick + delay).message

    return read_message


def _build_layout(rack: str, protocol: Protocol, case: Case) -> Layout:
    """Return the layout of a segment with one mailbox, its writer and its readers."""
    readers = tuple(f"reader{number}" for number in range(case.readers))
    tasks = tuple(
        TaskSpec(n, n, "executor", 2 + i, 0, 0, 1, 1, 4) for i, n in enumerate(("writer", *readers))
    )
    interrupt = None
    if protocol == "interrupt":
        # No message has to wait for another one, because every message is served before the next
        # one is sent.
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
        message=BenchMessage.message_type.name,
        version=BenchMessage.message_type.version,
        size=BenchMessage.message_type.build_dtype(case.lengths).itemsize,
        fields=build_field_specs(BenchMessage.message_type, case.lengths),
        interrupt=interrupt,
    )
    return Layout(rack, 2_500_000, tasks, (box,))
