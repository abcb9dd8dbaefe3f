"""NIST's controller before NASREM: state tables, executors alone, and an arm that is disturbed."""

from __future__ import annotations

from collections.abc import Sequence

from rack.boards.config import load
from rack.tools.lab.reproduction.experiments.experiment import Document, Experiment, Workshop
from rack.tools.recording.history import fired_rows

NAME = "nist-state-table"
UNDISTURBED = ("scene.motion=[]",)
"""Nothing in the cell moves but the arm."""
LASTS_S = 20.0


def _run(workshop: Workshop) -> Document:
    return {
        "disturbed": _task(workshop, NAME, ()),
        "undisturbed": _task(workshop, f"{NAME}-undisturbed", UNDISTURBED),
    }


TABLES = Experiment(
    NAME,
    "state tables, with a disturbance and without",
    LASTS_S,
    lambda: {"config": load(NAME).text(), "without": UNDISTURBED},
    _run,
)


def _task(workshop: Workshop, label: str, settings: Sequence[str]) -> Document:
    recording = workshop.run(label, workshop.config(NAME, ["clock.mode=lockstep", *settings]), None)
    ended = recording.ended
    return {
        "rows": fired_rows(recording),
        "outcome": {**ended["outcome"], "worked": ended["worked"]},
        "clock_ms": recording.rack_config.clock.period_ms,
    }
