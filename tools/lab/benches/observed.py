"""A rack run by a bench or an experiment, and recorded; and what is counted in its run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rack.boards.config.schema import CommandConfig, RackConfig
from rack.boards.timing.trace_times import lateness_ns, skipped
from rack.tools.launch.launch import RunResult, run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.recording import Recording

SETTLE_NS = 250_000_000
"""Start of a run, in which caches are cold: no peer is measured in its own."""


class Recorded(NamedTuple):
    """How a run went, and its recording."""

    result: RunResult
    recording: Recording


UNVIEWED = (
    "record.keep=600",
    "supervision.max_missed_fraction=1",
)
"""Settings of a rack whose recording nobody looks at: a flight recorder makes no viewer's file,
which takes a recorder of 1 kHz as long as the rest. Its lost cycles are measured, so they do not
fail its run."""


def record(
    config: RackConfig,
    seconds: float | None,
    folder: Path,
    share: bool = True,
) -> Recorded:
    """Run a rack as `run_rack` does, which raises, record it into `folder`, and show nothing."""
    result = run_rack(config, seconds, folder, Display(), share=share)
    return Recorded(result, Recording(folder))


def endless(config: RackConfig) -> RackConfig:
    """Return a rack that no board ends."""
    boards = {
        name: board.model_copy(update={"ends_run": False}) for name, board in config.board.items()
    }
    return config.model_copy(update={"board": boards})


def with_commands(config: RackConfig, commands: Sequence[CommandConfig]) -> RackConfig:
    """Return a rack to which an operator gives these commands, after its own."""
    return config.model_copy(update={"command": (*config.command, *commands)})


def lateness_us(recording: Recording, task: str) -> np.ndarray:
    """Return how late each cycle started, after the start of the run, us, shape (n,).

    After skipped releases it counts from the first of them, as that of any program that has
    overslept grid points.
    """
    rows = recording.trace(task)
    if len(rows):
        rows = rows[rows["release_ns"] >= rows["release_ns"][0] + SETTLE_NS]
    period_ns = recording.layout.task(task).every * recording.layout.clock_ns
    return np.asarray(lateness_ns(rows) + skipped(rows) * period_ns) * 1e-3


class CycleCount(NamedTuple):
    """Cycles of tasks: how many were missed or skipped, and how many were due."""

    missed: int
    due: int

    @property
    def share(self) -> float:
        """The share of those due that were missed or skipped."""
        return self.missed / self.due if self.due else 0.0


def count_cycles(tasks: Iterable[Mapping[str, int]]) -> CycleCount:
    """Return the cycles of several tasks or runs together; `tasks` are counts as in
    `RunResult.tasks`.
    """
    counts = list(tasks)
    missed = sum(task["missed"] + task["skipped"] for task in counts)
    return CycleCount(missed, sum(task["due"] for task in counts))
