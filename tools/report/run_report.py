"""The report of a run as a record with the fields of report.json."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from rack.tools.console.answer import Document


@dataclass(frozen=True)
class RunReport:
    """The report of a run: how it ended, the times of its tasks, and what happened in it.

    The attributes are the keys of report.json. A value is None if it needs a recording and the run
    was not recorded, or if it does not apply to the rack.

    Attributes:
        lockstep_load: Multiple of their budgets that cycles took on simulated cores. 0 without.
        worked: The verdict: True if the run succeeded.
        failures: Reasons why the run failed. Empty if it succeeded.
        unjudged: Aspects that the verdict does not cover.
        others: How the racks that were launched with this one ended.
        misses: Lost cycles, from `add_causes`.
        tasks: Dictionary from task to its times, from `compute_task_times`.
        system_response: Result of `measure_system_response`.
        summary: Lines of the summary, which a command prints without computing them again.
        against: Comparison with another run.
    """

    rack: str
    mode: str
    speed: float
    clock_ms: float
    worked: bool
    failures: list[str]
    unjudged: list[str]
    outcome: Any
    digest: str | None
    objects: list[Document]
    simulated_s: float
    wall_s: float
    clock_skipped: int
    missed: int
    skipped: int
    others: list[Document]
    lockstep_load: float | None = None
    folder: str | None = None
    continues: Any = None
    misses: Any = None
    steal: Any = None
    stalls: Any = None
    notes: Any = None
    holds: Any = None
    state_tables: Any = None
    faults: Any = None
    unexplained: Any = None
    restarts: Any = None
    standbys: Any = None
    tasks: Any = None
    system_response: Any = None
    data_ages: Any = None
    entries: Any = None
    network: Any = None
    task: Any = None
    motion: Any = None
    hand: Any = None
    force: Any = None
    queues: Any = None
    interrupts: Any = None
    recording: str = ""
    rows_lost: Any = None
    gaps: Any = None
    untraced: Any = None
    kept: Any = None
    bytes: Any = None
    bytes_per_s: Any = None
    summary: Any = None
    against: Any = None

    @property
    def takes_time(self) -> bool:
        """Whether computing took time: in real time, or on simulated cores."""
        return self.mode != "lockstep" or bool(self.lockstep_load)

    @classmethod
    def from_document(cls, document: Document) -> RunReport:
        """Build a report from the content of report.json. Missing keys become None."""
        values: Document = {field.name: document.get(field.name) for field in fields(cls)}
        return cls(**values)

    def to_document(self) -> Document:
        """Return the report as plain data, the content of report.json."""
        return dict(vars(self))
