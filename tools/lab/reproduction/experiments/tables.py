"""NIST's controller before NASREM: state tables, executors alone, and an arm that is disturbed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop
from rack.tools.lab.reproduction.experiments.tasks import TaskRun, task_run
from rack.tools.recording.history import fired_rows

NAME = "nist-state-table"
UNDISTURBED = ("scene.motion=[]", "clock.mode=lockstep")
"""Nothing in the cell moves but the arm; which rows fire then depends on no clock."""
LASTS_S = 55.0


@dataclass(frozen=True)
class TableRun(TaskRun):
    """A run of the task with the rows of state tables that fired, as "level: row"."""

    rows: tuple[str, ...]


@dataclass(frozen=True)
class TableRuns:
    """The task with what moves in the cell, in real time, and without."""

    disturbed: TableRun
    undisturbed: TableRun


def _measure(workshop: Workshop) -> TableRuns:
    return TableRuns(_task(workshop, NAME, ()), _task(workshop, f"{NAME}-undisturbed", UNDISTURBED))


TABLES = Experiment(
    NAME, "state tables, with a disturbance and without", LASTS_S, TableRuns, _measure
)


def _task(workshop: Workshop, label: str, settings: Sequence[str]) -> TableRun:
    result, recording = workshop.run(label, workshop.config(NAME, settings))
    fired = fired_rows(recording).items()
    rows = (f"{level}: {row['name']}" for level, rows in fired for row in rows)
    return TableRun(**vars(task_run(result, recording)), rows=tuple(rows))
