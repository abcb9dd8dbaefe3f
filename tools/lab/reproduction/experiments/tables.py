"""NIST's controller before NASREM: state tables, executors alone, and an arm that is disturbed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import TypeAdapter

from rack.tools.lab.reproduction.experiments.experiment import (
    Experiment,
    Workshop,
    need_real_time,
)
from rack.tools.recording.history import fired_rows

NAME = "nist-state-table"
UNDISTURBED = ("scene.motion=[]", "clock.mode=lockstep")
"""Nothing in the cell moves but the arm; which rows fire then depends on no clock."""
LASTS_S = 55.0


@dataclass(frozen=True)
class FiredRow:
    """A row of a state table that fired: in how many cycles, and when first, s."""

    name: str
    cycles: int
    first_s: float


@dataclass(frozen=True)
class TableRun:
    """A run of the task: the rows that fired, by level, and whether the task was done."""

    rows: dict[str, tuple[FiredRow, ...]]
    worked: bool


@dataclass(frozen=True)
class TableRuns:
    """The task with what moves in the cell, in real time, and without."""

    disturbed: TableRun
    undisturbed: TableRun


def _run(workshop: Workshop) -> TableRuns:
    need_real_time()
    return TableRuns(_task(workshop, NAME, ()), _task(workshop, f"{NAME}-undisturbed", UNDISTURBED))


TABLES = Experiment(
    NAME,
    "state tables, with a disturbance and without",
    LASTS_S,
    TableRuns,
    _run,
)


def _task(workshop: Workshop, label: str, settings: Sequence[str]) -> TableRun:
    config = workshop.config(NAME, settings)
    result, recording = workshop.run(label, config)
    rows = TypeAdapter(dict[str, tuple[FiredRow, ...]]).validate_python(fired_rows(recording))
    return TableRun(rows, result.worked)
