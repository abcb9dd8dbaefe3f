"""Runs of the paper's figures by real processes, recorded."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import pytest

from rack.boards.config import load
from rack.tools.live.display import Display
from rack.tools.live.launch import run_rack
from rack.tools.recording.recording import Recording
from rack.tools.timing.charts.measured import TracedRun
from rack.tools.timing.charts.panel import Panel

SLOWER = 8
"""Times of these runs as multiples of the figures': long compared with the boards' own work, on a
slow machine too."""
COMPUTED = 0.95
"""Part of its budget that a figure computes; some of the rest is the board's own work."""
SECONDS = 0.6
ATTEMPTS = 10
DISTURBED = 0.04
"""Part of a run's time lost to other programs from which on it is useless. Figure 2 leaves 0.11
free, one ms of 16 and what is not `COMPUTED`, in every plan; not all are disturbed alike."""


def slowed(name: str) -> list[str]:
    """Return the settings with which a figure has the same proportions, all of it `SLOWER`."""
    budget = load(name).board["level"].budget
    assert budget is not None
    times = {key: SLOWER * ms for key, ms in budget.model_dump(exclude_none=True).items()}
    made = {
        "params": ("process_ms", "plan_ms"),
        "transfer": ("read_ms", "write_ms", "exchange_ms", "update_ms"),
    }
    settings = [
        f"board.level.{table}.{key}={COMPUTED * times[key]}"
        for table, keys in made.items()
        for key in keys
    ]
    return [
        f"clock.speed={1 / SLOWER}",
        *settings,
        *(f"board.level.budget.{key}={ms}" for key, ms in times.items()),
    ]


def run(name: str, folder: Path, *settings: str, seconds: float = SECONDS) -> TracedRun:
    """Run a rack of the figures under a name of its own, into `folder`, and return the run."""
    # Some figures show levels that are late throughout.
    own = (f"name=test-{os.getpid()}-{name}", "supervision.max_missed_fraction=1")
    config = load(name, [*own, *settings])
    result = run_rack(config, seconds, folder, Display())
    assert result.worked, result.failure()
    return TracedRun(Recording(folder))


def undisturbed(name: str, folder: Path, *settings: str) -> TracedRun:
    """Return a run in which other programs had its cores only briefly: the first of several
    attempts."""
    for attempt in range(ATTEMPTS):
        found = run(name, folder / str(attempt), *slowed(name), *settings)
        if lost(found) < DISTURBED:
            return found
    pytest.skip(f"the machine took {DISTURBED:.0%} and more of every run of {name} away")


def lost(found: TracedRun) -> float:
    """Return the part of a run in which its tasks waited for a core, or were on one without
    computing.

    An executor is ready at its release, a planner when its executor has let go of the core.
    """
    cycles = found.recording.cycles
    waited = sum(
        int((rows["start_ns"] - rows["release_ns"]).clip(0).sum()) for rows in (cycles["level"],)
    )
    charted = sum(span.end_ns - span.start_ns for span in found.chart(0, found.end_ns).spans)
    computed = sum(int(rows["processor_ns"].sum()) for rows in cycles.values())
    return (waited + max(0, charted - computed)) / found.end_ns


def whole(found: TracedRun) -> Panel:
    """Return the panel of a whole run."""
    return found.panel(0, found.end_ns, lambda part: None)


def usual(counts: Counter[str]) -> str:
    """Return the most frequent pattern: a machine that wakes processes late makes many others, each
    rare."""
    return counts.most_common(1)[0][0]
