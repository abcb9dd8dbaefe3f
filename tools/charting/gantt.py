"""A Gantt chart of a config or of a run: its panels, as text, as plain data and as a picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rack.boards.config import budgets
from rack.tools.charting.measured import Run
from rack.tools.charting.panel import Panel
from rack.tools.charting.scheduled import Schedule
from rack.tools.charting.subject import Subject
from rack.tools.charting.text import column_for, lines
from rack.tools.charting.window import Wanted
from rack.tools.console.answer import Failure

NO_BUDGET = "no board has a budget: give [board.<name>.budget], or --set board.<name>.budget.process_ms=1"


@dataclass(frozen=True)
class Gantt:
    """Panels of one window of time, the measurement above the schedule, and what has to be said beside them."""

    rack: str
    panels: tuple[Panel, ...]
    notes: tuple[str, ...]
    column_ns: int

    @property
    def spans(self) -> int:
        """How many spans there are to draw."""
        return sum(len(panel.chart.spans) for panel in self.panels)

    def text(self) -> str:
        """Return the chart as text."""
        panels = ["\n".join([f"{self.rack}: {first}", *rest]) for first, *rest in map(self._lines, self.panels)]
        return "\n\n".join([*panels, *self.notes])

    def _lines(self, panel: Panel) -> list[str]:
        return list(lines(panel, self.column_ns))

    def document(self) -> dict[str, Any]:
        """Return the chart as plain data."""
        panels = [panel.document() for panel in self.panels]
        return {"rack": self.rack, "panels": panels, "notes": list(self.notes)}

    def save(self, folder: Path) -> list[Path]:
        """Draw the chart into `folder`, which must be there; return the paths of the pictures."""
        from rack.tools.charting.picture import save

        return save(self.panels, self.rack, folder / "gantt")


def gantt_of(
    subject: Subject, wanted: Wanted, process_ns: Mapping[str, Sequence[int]], told: Callable[[float], None]
) -> Gantt:
    """Return the chart of a subject. Raises `Failure`.

    `process_ns` are times of X in a schedule that change from cycle to cycle, by board. `told` is called with the part
    of a run that is counted.
    """
    name, run = subject.config.name, subject.run
    schedule = Schedule(subject.config, subject.layout, process_ns) if budgets(subject.config) else None
    if run is not None and not run.is_lockstep:
        return _of_run(name, run, schedule, wanted, told)
    still = f"{name} ran in lockstep, and time stood still while its tasks computed"
    if schedule is None:
        raise Failure(f"{still}; {NO_BUDGET}" if run is not None else f"{name}: {NO_BUDGET}", 2)
    start, end = wanted.window(wanted.task(schedule.tasks), None, 0)
    notes = () if run is None else (f"{still}, so that only the schedule is shown",)
    return Gantt(name, (schedule.panel(start, end),), notes, column_for(end - start, schedule.shortest_ns))


def _of_run(name: str, run: Run, schedule: Schedule | None, wanted: Wanted, told: Callable[[float], None]) -> Gantt:
    task = wanted.task(run.tasks)
    start, end = wanted.window(task, run.end_ns, run.middle_ns(task))
    measured = run.panel(start, end, told)
    if schedule is None:
        return Gantt(name, (measured,), (f"no schedule beneath: {NO_BUDGET}",), column_for(end - start, None))
    schedule.on_cores_of(run.recording.layout)
    return Gantt(name, (measured, schedule.panel(start, end)), (), column_for(end - start, schedule.shortest_ns))
