"""Measures an access to a mailbox: a message of 200 bytes, written and read, its fields included."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rack.backplane import semaphores
from rack.backplane.layout import PROTOCOLS, Layout, MailboxSpec, Protocol, TaskSpec
from rack.backplane.mailbox.protocols import open_reader, open_writer
from rack.backplane.message import Field, command
from rack.backplane.segment import Segment, unlink
from rack.boards.config.layout import field_specs

CALLS = 20_000
ROUNDS = 15
MESSAGE = command(
    "bench",
    1,
    Field("position", "f8", "rad", "joint positions", ("joints",)),
    Field("velocity", "f8", "rad/s", "joint velocities", ("joints",)),
    Field("torque", "f8", "N m", "joint torques", ("joints",)),
)
SIZES = {"joints": 8}


@dataclass(frozen=True)
class MailboxCost:
    """Cost of an access by one protocol, us: medians over rounds, and the fastest round."""

    protocol: Protocol
    bytes: int
    write_us: float
    read_us: float
    write_best_us: float
    read_best_us: float


def measure() -> list[MailboxCost]:
    """Return the cost of every protocol; rounds are interleaved, as the machine's speed drifts."""
    rack = f"bench-{os.getpid()}"
    layout = _layout(rack)
    segment = Segment.create(layout, "")
    semaphores.create(layout)
    try:
        accesses = {p: _accesses(segment, p) for p in PROTOCOLS}
        times: dict[Protocol, list[tuple[float, float]]] = {p: [] for p in PROTOCOLS}
        for _ in range(ROUNDS):
            for protocol, (write, both) in accesses.items():
                times[protocol].append((_us_a_call(write), _us_a_call(both)))
        return [_cost(layout, protocol, rounds) for protocol, rounds in times.items()]
    finally:
        semaphores.unlink(layout)
        unlink(rack)


def _layout(rack: str) -> Layout:
    size = MESSAGE.dtype(SIZES).itemsize
    tasks = tuple(TaskSpec(n, n, "executor", 2 + i, 0, 0, 1, 1, 4) for i, n in enumerate(("writer", "reader")))
    boxes = tuple(
        MailboxSpec(
            name=f"writer.{protocol}",
            writer="writer",
            readers=("reader",),
            protocol=protocol,
            every=1,
            delay=1,
            depth=64,
            message=MESSAGE.name,
            version=MESSAGE.version,
            size=size,
            fields=field_specs(MESSAGE, SIZES),
        )
        for protocol in PROTOCOLS
    )
    return Layout(rack, 2_500_000, tasks, boxes)


def _accesses(segment: Segment, protocol: Protocol) -> tuple[Callable[[], None], Callable[[], None]]:
    writer, reader = open_writer(segment, f"writer.{protocol}"), open_reader(segment, f"writer.{protocol}")
    message, joints, tick = writer.message, np.linspace(-1.0, 1.0, SIZES["joints"]), 0

    def write() -> None:
        nonlocal tick
        tick += 1
        message.id = tick
        message.position[:] = joints
        writer.write(tick)

    def read() -> None:
        reading = reader.read(tick + 1)
        joints[0] = reading.value.position[0]

    def both() -> None:
        write()
        read()

    return write, both


def _us_a_call(call: Callable[[], None]) -> float:
    start = time.perf_counter_ns()
    for _ in range(CALLS):
        call()
    return (time.perf_counter_ns() - start) / CALLS / 1000


def _cost(layout: Layout, protocol: Protocol, rounds: list[tuple[float, float]]) -> MailboxCost:
    # Reading an old message again copies nothing: so a read is the time of a write and a read, less a write.
    writes, pairs = zip(*rounds, strict=True)
    write_us, best_us = statistics.median(writes), min(writes)
    return MailboxCost(
        protocol=protocol,
        bytes=layout.mailbox(f"writer.{protocol}").size,
        write_us=round(write_us, 3),
        read_us=round(statistics.median(pairs) - write_us, 3),
        write_best_us=round(best_us, 3),
        read_best_us=round(min(pairs) - best_us, 3),
    )


def lines_of(costs: Sequence[MailboxCost]) -> Iterator[str]:
    """Yield the figures as text for people."""
    yield f"mailbox: {costs[0].bytes} bytes, field access to numpy views included; us a call, median (best)"
    for cost in costs:
        write = f"{cost.write_us:.2f} ({cost.write_best_us:.2f})"
        read = f"{cost.read_us:.2f} ({cost.read_best_us:.2f})"
        yield f"  {cost.protocol:14} write {write:14} read {read}"
