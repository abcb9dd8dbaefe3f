"""Measures what recording costs the boards: misses and lateness without a recorder, with it, and
with a live viewer."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rack.backplane.process import processor_ns
from rack.backplane.ring import Ring
from rack.backplane.trace import trace_ring
from rack.boards import Rack
from rack.boards.config import load
from rack.levels.timing.trace_times import Distribution, counts, distribution, lateness_ns
from rack.tools.console.answer import Failure
from rack.tools.console.tables import decimal, figure, table
from rack.tools.recording.recorder_process import RecorderProcess
from rack.tools.viewer.window import ViewerWindow, free_port, url

PHASES = ("without", "recording", "live viewer")
PHASE_S = 6.0
SETTLE_S = 1.0
"""Time for a recorder to attach and a viewer to draw: the cost of starting them is not measured."""
ROUNDS = 3


@dataclass(frozen=True)
class RecordingCost:
    """All rounds of one phase: cycles, missed and skipped ones, of all tasks; lateness of the
    fastest task in ms.

    `recorder_percent` is the recorder's share of one core; 0 without one.
    """

    phase: str
    cycles: int
    missed: int
    skipped: int
    lateness_ms: Distribution | None
    recorder_percent: float


class _Sample(NamedTuple):
    """Trace records of every task, read again and again, and the recorder's share of a core."""

    readings: list[list[np.ndarray]]
    recorder_percent: float


def measure(name: str) -> list[RecordingCost]:
    """Return the cost on the rack of a config; phases are interleaved, as the machine's speed
    drifts.

    Raises `Failure` if the rack ends early or a recorder cannot attach.
    """
    config = load(name, [f"name=bench-{os.getpid()}", "clock.mode=realtime"])
    endless = {
        name: board.model_copy(update={"ends_run": False}) for name, board in config.board.items()
    }
    config = config.model_copy(update={"board": endless})
    found: dict[str, list[_Sample]] = {phase: [] for phase in PHASES}
    with tempfile.TemporaryDirectory() as folder, Rack(config) as rack:
        rack.start()
        # The fastest task first: its lateness is shown.
        tasks = sorted(rack.segment.layout.tasks, key=lambda task: task.every)
        rings = [trace_ring(rack.segment, task.name) for task in tasks]
        _watch(rack, SETTLE_S)
        for turn in range(ROUNDS):
            for phase in PHASES:
                with _recorder(rack, phase, Path(folder) / f"{phase}-{turn}") as pid:
                    _watch(rack, SETTLE_S)
                    _drained(rings)
                    used_ns = _processor_ns(pid)
                    began_ns = time.monotonic_ns()
                    readings = [_reading(rack, rings) for _ in range(round(PHASE_S))]
                    share = (
                        100.0 * (_processor_ns(pid) - used_ns) / (time.monotonic_ns() - began_ns)
                    )
                    found[phase].append(_Sample(readings, share))
        rack.stop("measured")
        while rack.watch(0.5):
            continue
    return [_cost(phase, samples) for phase, samples in found.items()]


def _reading(rack: Rack, rings: Sequence[Ring]) -> list[np.ndarray]:
    # The rings hold two seconds.
    _watch(rack, 1.0)
    return _drained(rings)


def _drained(rings: Sequence[Ring]) -> list[np.ndarray]:
    """Return the trace records since the last call, task by task."""
    return [ring.drain().rows for ring in rings]


@contextmanager
def _recorder(rack: Rack, phase: str, folder: Path) -> Iterator[int | None]:
    """Record while the context lasts, unless the phase is without; yield the recorder's process
    id."""
    if phase == PHASES[0]:
        yield None
        return
    folder.mkdir()
    recorder = RecorderProcess()
    port = free_port() if phase == PHASES[2] else None
    window = None
    try:
        if not recorder.attach(rack.config.name, folder, port):
            raise Failure(recorder.finish())
        window = None if port is None else ViewerWindow(url(port), headless=True)
        yield recorder.pid
    finally:
        if window is not None:
            window.close()
        recorder.finish()


def _watch(rack: Rack, seconds: float) -> None:
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0:
        if not rack.watch(left):
            raise Failure(f"the rack ended during the measurement: {rack.outcome}")


def _processor_ns(pid: int | None) -> int:
    return 0 if pid is None else processor_ns(pid)


def _cost(phase: str, samples: Sequence[_Sample]) -> RecordingCost:
    readings = [reading for sample in samples for reading in sample.readings]
    cycles = np.concatenate([rows for reading in readings for rows in reading])
    missed, skipped = counts(cycles)
    return RecordingCost(
        phase=phase,
        cycles=len(cycles),
        missed=missed,
        skipped=skipped,
        lateness_ms=distribution(
            lateness_ns(np.concatenate([reading[0] for reading in readings])) * 1e-6
        ),
        recorder_percent=round(float(np.mean([sample.recorder_percent for sample in samples])), 2),
    )


def lines_of(costs: Sequence[RecordingCost], width: int | None = None) -> Iterator[str]:
    """Yield a table for people, fitted to `width`."""
    head = [
        "phase",
        "cycles",
        "missed",
        "skipped",
        "late p50, ms",
        "p99",
        "p99.9",
        "max",
        "recorder, % of a core",
    ]
    rows = [
        [
            cost.phase,
            str(cost.cycles),
            str(cost.missed),
            str(cost.skipped),
            *(figure(cost.lateness_ms, name) for name in ("p50", "p99", "p99_9", "max")),
            decimal(cost.recorder_percent, 1),
        ]
        for cost in costs
    ]
    yield from table(head, rows, width, ("cycles", "p99.9", "late p50, ms"))
