"""The same rack in lockstep and in real time: do all runs write the same messages?"""

from __future__ import annotations

from dataclasses import dataclass

from rack.tools.lab.benches.observed import Recorded
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop
from rack.tools.recording.divergence import Difference, first_difference
from rack.tools.recording.history import misses
from rack.tools.recording.recording import Recording

NAME = "nasrem"
SECONDS = 6.0
"""Simulated time, long enough for the arm to move."""
ATTEMPTS = 3
"""Most runs in real time: one without a missed deadline is wanted."""
LASTS_S = 2 * 3.0 + 2 * (SECONDS + 3.0)


@dataclass(frozen=True)
class ComparedRun:
    """The digest of a run, the tick of its first missed deadline, and where it diverges from the
    first run."""

    mode: str
    digest: str
    first_miss: int | None
    difference: Difference | None


@dataclass(frozen=True)
class ComparedRuns:
    """Runs in lockstep, then in real time."""

    runs: tuple[ComparedRun, ...]


def _measure(workshop: Workshop) -> ComparedRuns:
    first, second = (_recorded(workshop, f"{NAME}-lockstep-{k}", "lockstep") for k in (1, 2))
    runs = [_compared(first, None), _compared(second, first.recording)]
    for attempt in range(1, ATTEMPTS + 1):
        run = _recorded(workshop, f"{NAME}-realtime-{attempt}", "realtime")
        runs.append(_compared(run, first.recording))
        if runs[-1].first_miss is None:
            break
    return ComparedRuns(tuple(runs))


DETERMINISM = Experiment(
    "determinism",
    "nasrem twice in lockstep, then in real time",
    LASTS_S,
    ComparedRuns,
    _measure,
    cores=0,
)


def _recorded(workshop: Workshop, label: str, mode: str) -> Recorded:
    return workshop.run(label, workshop.config(NAME, [f"clock.mode={mode}"]), SECONDS)


def _compared(run: Recorded, reference: Recording | None) -> ComparedRun:
    result, recording = run
    return ComparedRun(
        mode=recording.rack_config.clock.mode,
        digest=result.outcome.digest,
        first_miss=min((miss["tick"] for miss in misses(recording)), default=None),
        difference=None if reference is None else first_difference(recording, reference),
    )
