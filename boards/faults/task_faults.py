"""The faults of one task, as its process does them: on what it writes, in its computing time, in what it drives."""

from __future__ import annotations

from collections.abc import Sequence
from time import monotonic_ns
from typing import Protocol

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.fault_table import Entry, FaultEntry, FaultTable
from rack.backplane.layout import TaskSpec
from rack.backplane.segment import Segment
from rack.boards.faults.kinds import KINDS
from rack.boards.faults.load import Load
from rack.levels.level import Executor, Fault, Planner


class Outputs(Protocol):
    """The outputs of a task, as far as faults concern them."""

    def apply(self, faults: Sequence[tuple[str, FaultEntry]]) -> None:
        """Write with these faults, by kind, from now on."""


class TaskFaults:
    """Keeps a task's active faults in force; `loads` are those of its computing time."""

    def __init__(self, segment: Segment, spec: TaskSpec, outputs: Outputs, level: Executor | Planner) -> None:
        self._table = FaultTable(segment)
        self._spec, self._outputs, self._level = spec, outputs, level
        self._clock = SystemClock(segment)
        self._arm: list[FaultEntry] = []
        self.loads: list[Load] = []

    def refresh(self) -> int:
        """Take over what is active now; return the generation of the table that was seen."""
        generation = self._table.generation
        active = [(KINDS[entry[Entry.KIND]], entry) for entry in self._table.active(self._spec.name)]
        self.loads = [Load(entry, self._spec, self._clock) for kind, entry in active if kind.where == "load"]
        self._outputs.apply([(kind.name, entry) for kind, entry in active if kind.where in ("writer", "lock")])
        self._arm = [entry for kind, entry in active if kind.where == "arm"]
        if isinstance(self._level, Executor):
            self._level.inject([_fault(entry) for entry in self._arm])
        return generation

    def burn(self, tick: int) -> None:
        """Compute as long as the faults of computing time say."""
        for load in self.loads:
            load.burn(tick)

    def count(self, places: Sequence[int], tick: int) -> None:
        """Count that the arm's faults at these places of the injected sequence have acted."""
        now = monotonic_ns()
        for place in places:
            self._arm[place].acted(tick, now)


def _fault(entry: FaultEntry) -> Fault:
    kind = KINDS[entry[Entry.KIND]]
    named = {parameter.name: entry.parameters[place] for place, parameter in enumerate(kind.parameters)}
    return Fault(kind.name, named, entry[Entry.SEED], entry[Entry.FROM])
