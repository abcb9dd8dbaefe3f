"""What recording costs the boards: one rack without a recorder, with it, and with a live viewer, by
turns."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import NamedTuple

import numpy as np

from rack.backplane.process import processor_ns
from rack.backplane.ring import Ring
from rack.backplane.trace import trace_ring
from rack.boards import Rack
from rack.boards.config import load
from rack.levels.timing.trace_times import counts, lateness_ns
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.harness import Comparison, Sample, interleaved
from rack.tools.lab.benches.observed import endless
from rack.tools.recording.recorder_process import RecorderProcess
from rack.tools.viewer.window import ViewerWindow, free_port, url

PHASES = ("without", "recording", "live viewer")
READINGS = 6
SETTLE_S = 1.0
"""Time for a recorder to attach and a viewer to draw: the cost of starting them is not measured."""
ROUNDS = 3


class PhaseCost(NamedTuple):
    """What one turn of a phase has shown: lateness of the fastest task, and shares in %."""

    lateness_ms: list[float]
    missed: float
    processor: float


def measure(name: str, progress: Progress) -> Comparison:
    """Return the cost on the rack of a config.

    Raises `Failure` if the rack ends early or a recorder cannot attach.
    """
    config = load(name, [f"name=bench-{os.getpid()}", "clock.mode=realtime"])
    each_s = READINGS + SETTLE_S
    progress.total(ROUNDS * len(PHASES) * each_s)
    with TemporaryDirectory(prefix="rack-bench-") as folder, Rack(endless(config)) as rack:
        rack.start()
        # The fastest task first: its lateness is shown.
        tasks = sorted(rack.segment.layout.tasks, key=lambda task: task.every)
        rings = [trace_ring(rack.segment, task.name) for task in tasks]
        phases = {phase: partial(_measure, rack, rings, phase, folder) for phase in PHASES}
        found = interleaved(phases, ROUNDS, progress, each_s)
        rack.stop("measured")
        while rack.watch(0.5):
            continue
    return costs(tasks[0].name, found)


def costs(task: str, found: dict[str, list[PhaseCost]]) -> Comparison:
    """Return the comparison of the turns of each phase with those without a recorder."""
    samples = [
        Sample(case, phase, tuple(values), unit)
        for case, unit, values_of in (
            (f"lateness of {task}", "ms", lambda cost: cost.lateness_ms),
            ("cycles missed or skipped, of all tasks", "%", lambda cost: [cost.missed]),
            ("the recorder's processor time, of a core", "%", lambda cost: [cost.processor]),
        )
        for phase, turns in found.items()
        if (values := [value for cost in turns for value in values_of(cost)])
    ]
    baselines = {sample.case: PHASES[0] for sample in samples}
    return Comparison("recording", "What recording costs", tuple(samples), baselines)


def _measure(rack: Rack, rings: Sequence[Ring], phase: str, scratch: str) -> PhaseCost:
    with _recorder(rack, phase, Path(mkdtemp(dir=scratch))) as pid:
        _read(rack, rings)
        used_ns = _processor_ns(pid)
        began_ns = time.monotonic_ns()
        readings = [_read(rack, rings) for _ in range(READINGS)]
        used_ns = _processor_ns(pid) - used_ns
        lasted_ns = time.monotonic_ns() - began_ns
    cycles = np.concatenate([rows for reading in readings for rows in reading])
    late_ns = lateness_ns(np.concatenate([reading[0] for reading in readings]))
    missed = 100.0 * sum(counts(cycles)) / max(1, len(cycles))
    return PhaseCost((late_ns * 1e-6).tolist(), missed, 100.0 * used_ns / lasted_ns)


def _read(rack: Rack, rings: Sequence[Ring]) -> list[np.ndarray]:
    """Return the trace records of the next second, task by task: the rings hold two."""
    until = time.monotonic() + SETTLE_S
    while (left := until - time.monotonic()) > 0:
        if not rack.watch(left):
            raise Failure(f"the rack ended during the measurement: {rack.outcome}")
    return [ring.drain().rows for ring in rings]


@contextmanager
def _recorder(rack: Rack, phase: str, folder: Path) -> Iterator[int | None]:
    """Record while the context lasts, unless the phase is without; yield the recorder's process
    id."""
    if phase == PHASES[0]:
        yield None
        return
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


def _processor_ns(pid: int | None) -> int:
    return 0 if pid is None else processor_ns(pid)
