"""Measures what recording costs the boards: misses and lateness without a recorder, with it, and with a live viewer."""

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
from rack.backplane.segment import Segment
from rack.backplane.trace import Flag, trace_ring
from rack.boards.config import RackConfig, load
from rack.boards.rack import Rack
from rack.levels.timing.trace_times import Distribution, distribution, lateness_ns
from rack.tools.answer import Failure
from rack.tools.recorder.process import RecorderProcess
from rack.tools.text_table import table
from rack.tools.viewer.window import Window, free_port, url

PHASES = ("without", "recording", "live viewer")
PHASE_S = 6.0
SETTLE_S = 1.0
"""Time for a recorder to attach and a viewer to draw: the cost of starting them is not measured."""
ROUNDS = 3


@dataclass(frozen=True)
class RecordingCost:
    """All rounds of one phase: cycles, misses and skips of all tasks, lateness of the fastest task in ms.

    `recorder_percent` is the recorder's share of one core; 0 without one.
    """

    phase: str
    cycles: int
    missed: int
    skipped: int
    lateness_ms: Distribution | None
    recorder_percent: float


class _Sample(NamedTuple):
    """One round of one phase; `flags` and `lateness_ms` are of shape (cycles,)."""

    flags: np.ndarray
    lateness_ms: np.ndarray
    recorder_percent: float


class Meter:
    """Reads the traces of a running rack, phase by phase."""

    def __init__(self, segment: Segment) -> None:
        self._rings = {task.name: trace_ring(segment, task.name) for task in segment.layout.tasks}
        self._fastest = min(segment.layout.tasks, key=lambda task: task.every).name

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the flags of all cycles since the last call, and the fastest task's lateness in ms."""
        rows = {task: ring.drain().rows for task, ring in self._rings.items()}
        fastest = rows[self._fastest]
        flags = np.concatenate([taken["flags"] for taken in rows.values()])
        return flags, lateness_ns(fastest) * 1e-6


def measure(name: str) -> list[RecordingCost]:
    """Return the cost on the rack of a config; phases are interleaved, as the machine's speed drifts.

    Raises `Failure` if the rack ends early or a recorder cannot attach.
    """
    config = _endless(load(name, [f"name=bench-{os.getpid()}", "clock.mode=realtime"]))
    found: dict[str, list[_Sample]] = {phase: [] for phase in PHASES}
    with tempfile.TemporaryDirectory() as folder, Rack(config) as rack:
        rack.start()
        meter = Meter(rack.segment)
        _watch(rack, SETTLE_S)
        for turn in range(ROUNDS):
            for phase in PHASES:
                with _recorder(rack, phase, Path(folder) / f"{phase}-{turn}") as pid:
                    _watch(rack, SETTLE_S)
                    meter.read()
                    used_ns, began_ns = _processor_ns(pid), time.monotonic_ns()
                    flags, lateness = zip(*(_reading(rack, meter) for _ in range(round(PHASE_S))), strict=True)
                    share = 100.0 * (_processor_ns(pid) - used_ns) / (time.monotonic_ns() - began_ns)
                    found[phase].append(_Sample(np.concatenate(flags), np.concatenate(lateness), share))
        rack.stop("measured")
        while rack.watch(0.5):
            continue
    return [_cost(phase, samples) for phase, samples in found.items()]


def _endless(config: RackConfig) -> RackConfig:
    boards = {name: board.model_copy(update={"ends_run": False}) for name, board in config.board.items()}
    return config.model_copy(update={"board": boards})


def _reading(rack: Rack, meter: Meter) -> tuple[np.ndarray, np.ndarray]:
    # The rings hold two seconds.
    _watch(rack, 1.0)
    return meter.read()


@contextmanager
def _recorder(rack: Rack, phase: str, folder: Path) -> Iterator[int | None]:
    """Record while the context lasts, unless the phase is without; yield the recorder's process id."""
    if phase == PHASES[0]:
        yield None
        return
    folder.mkdir()
    recorder, port = RecorderProcess(), free_port() if phase == PHASES[2] else None
    window = None
    try:
        if not recorder.attach(rack.config.name, folder, port):
            raise Failure(recorder.finish())
        window = None if port is None else Window(url(port), headless=True)
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
    flags = np.concatenate([sample.flags for sample in samples])
    return RecordingCost(
        phase=phase,
        cycles=len(flags),
        missed=int(np.count_nonzero(flags & Flag.MISSED)),
        skipped=int(np.count_nonzero(flags & Flag.SKIPPED)),
        lateness_ms=distribution(np.concatenate([sample.lateness_ms for sample in samples])),
        recorder_percent=round(float(np.mean([sample.recorder_percent for sample in samples])), 2),
    )


def lines_of(costs: Sequence[RecordingCost], width: int | None = None) -> Iterator[str]:
    """Yield a table for people, fitted to `width`."""
    head = ["phase", "cycles", "missed", "skipped", "late p50, ms", "p99", "p99.9", "max", "recorder, % of a core"]
    rows = [
        [
            *(cost.phase, str(cost.cycles), str(cost.missed), str(cost.skipped)),
            *(f"{cost.lateness_ms[name]:.3f}" if cost.lateness_ms else "-" for name in ("p50", "p99", "p99_9", "max")),
            f"{cost.recorder_percent:.1f}",
        ]
        for cost in costs
    ]
    yield from table(head, rows, width, ("cycles", "p99.9", "late p50, ms"))
