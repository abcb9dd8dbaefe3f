"""What recording costs the boards: misses and lateness without, with a recorder, and with a live viewer, in one run."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rack.backplane.segment import Segment
from rack.backplane.trace import Flag, trace_ring
from rack.boards import Rack
from rack.boards.config import RackConfig, load
from rack.tools.answer import Failure
from rack.tools.recorder.process import RecorderProcess
from rack.tools.reporting.statistics import Distribution, distribution
from rack.tools.viewer.window import Window, free_port, url

PHASES = ("without", "recording", "live viewer")
PHASE_S = 6.0
SETTLE_S = 1.0
"""A recorder has attached, a viewer is about to draw: what starting them costs is not what is asked."""
ROUNDS = 3
CLOCK_TICK_S = 1 / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class RecordingCost:
    """All rounds of one phase: cycles of all tasks, what was missed, lateness of the fastest task in ms.

    `recorder_percent` is the recorder's part of one core; 0 without one.
    """

    phase: str
    cycles: int
    missed: int
    skipped: int
    lateness_ms: Distribution | None
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
        return flags, (fastest["start_ns"] - fastest["release_ns"]) * 1e-6


def measure(name: str) -> list[RecordingCost]:
    """Return the cost on the rack of a config; phases are interleaved, for the machine's speed drifts.

    Raises `Failure` when the rack ends early or a recorder cannot attach.
    """
    config = _endless(load(name, [f"name=bench-{os.getpid()}", "clock.mode=realtime"]))
    found: dict[str, list[tuple[np.ndarray, np.ndarray, float]]] = {phase: [] for phase in PHASES}
    with tempfile.TemporaryDirectory() as folder, Rack(config) as rack:
        rack.start()
        meter = Meter(rack.segment)
        _watch(rack, SETTLE_S)
        for turn in range(ROUNDS):
            for phase in PHASES:
                with _recorder(rack, phase, Path(folder) / f"{phase}-{turn}") as pid:
                    _watch(rack, SETTLE_S)
                    meter.read()
                    cpu_s, began = _cpu_s(pid), time.monotonic()
                    readings = [_reading(rack, meter) for _ in range(round(PHASE_S))]
                    share = 100.0 * (_cpu_s(pid) - cpu_s) / (time.monotonic() - began)
                    found[phase] += [(flags, lateness, share) for flags, lateness in readings]
        rack.stop("measured")
        while rack.watch(0.5):
            continue
    return [_cost(phase, taken) for phase, taken in found.items()]


def _endless(config: RackConfig) -> RackConfig:
    boards = {name: board.model_copy(update={"ends_run": False}) for name, board in config.board.items()}
    return config.model_copy(update={"board": boards})


def _reading(rack: Rack, meter: Meter) -> tuple[np.ndarray, np.ndarray]:
    # The rings hold two seconds.
    _watch(rack, 1.0)
    return meter.read()


@contextmanager
def _recorder(rack: Rack, phase: str, folder: Path) -> Iterator[int | None]:
    """Record while the context lasts, unless the phase is without; give the recorder's process id."""
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
            raise Failure(f"the rack ended while it was measured: {rack.outcome}")


def _cpu_s(pid: int | None) -> float:
    """Return the processor time that a process has had, in s."""
    if pid is None:
        return 0.0
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * CLOCK_TICK_S


def _cost(phase: str, taken: list[tuple[np.ndarray, np.ndarray, float]]) -> RecordingCost:
    flags, lateness = (np.concatenate(column) for column in list(zip(*taken, strict=True))[:2])
    return RecordingCost(
        phase=phase,
        cycles=len(flags),
        missed=int(np.count_nonzero(flags & Flag.MISSED)),
        skipped=int(np.count_nonzero(flags & Flag.SKIPPED)),
        lateness_ms=distribution(lateness),
        recorder_percent=round(float(np.mean([share for _, _, share in taken])), 2),
    )
