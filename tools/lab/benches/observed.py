"""Recorded runs for benches and experiments, and counts of their cycles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rack.boards.config.schema import RackConfig
from rack.boards.timing.trace_times import compute_lateness_ns, count_skipped_releases
from rack.tools.launch.launch import RunResult, run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.recording import Recording

SETTLE_NS = 250_000_000
"""Time at the start of a run that is not measured, because caches are cold, ns.

The peers are not measured at their start either.
"""


class ObservedRun(NamedTuple):
    """Result of a run, and its recording."""

    result: RunResult
    recording: Recording


UNVIEWED_SETTINGS = (
    "record.keep=600",
    "supervision.max_missed_fraction=1",
)
"""Settings of a rack whose recording is not viewed.

The flight recorder writes no file for the viewer, because this would double the work of a recorder
at 1 kHz. Missed cycles are measured and therefore do not fail the run.
"""


def record_rack(
    config: RackConfig,
    seconds: float | None,
    folder: Path,
    share: bool = True,
) -> ObservedRun:
    """Run a rack as `run_rack` does, without display, and record it.

    Args:
        config: Rack to run.
        seconds: Time of the run, s. None to run until a board ends it.
        folder: Folder of the run.
        share: Whether to run even on cores that another rack uses.
    """
    result = run_rack(config, seconds, folder, Display(), share=share)
    return ObservedRun(result, Recording(folder))


def remove_run_end(config: RackConfig) -> RackConfig:
    """Return a config in which no board ends the run."""
    boards = {
        name: board.model_copy(update={"ends_run": False}) for name, board in config.board.items()
    }
    return config.model_copy(update={"board": boards})


def compute_lateness_us(recording: Recording, task: str) -> np.ndarray:
    """Return the lateness of each cycle after the start-up of the run, (n,), in us.

    After skipped releases, the lateness is measured from the first skipped one, as for any program
    that sleeps past several grid points.
    """
    rows = recording.read_trace(task)
    if len(rows):
        rows = rows[rows["release_ns"] >= rows["release_ns"][0] + SETTLE_NS]
    period_ns = recording.layout.find_task(task).every * recording.layout.clock_ns
    return np.asarray(compute_lateness_ns(rows) + count_skipped_releases(rows) * period_ns) * 1e-3


class CycleCount(NamedTuple):
    """Numbers of missed or skipped cycles and of due cycles."""

    missed: int
    due: int

    @property
    def share(self) -> float:
        """Fraction of the due cycles that were missed or skipped. 0 if none was due."""
        return self.missed / self.due if self.due else 0.0


def count_cycles(tasks: Iterable[Mapping[str, int]]) -> CycleCount:
    """Add up the cycles of several tasks or runs, given as in `RunResult.tasks`."""
    counts = list(tasks)
    missed = sum(task["missed"] + task["skipped"] for task in counts)
    return CycleCount(missed, sum(task["due"] for task in counts))
