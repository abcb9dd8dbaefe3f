"""A Gantt chart of a config or of a run, as text, as plain data and as a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from rack.backplane.layout import Layout
from rack.boards.config import RackConfig, load, read_budgets, resolve_layout
from rack.tools.console.answer import Document, Failure
from rack.tools.launch.folder import RUNS
from rack.tools.recording.recording import Recording
from rack.tools.timing.charts.letters import choose_column_ns, format_panel
from rack.tools.timing.charts.measured import TracedRun
from rack.tools.timing.charts.panel import Panel
from rack.tools.timing.charts.scheduled import Schedule
from rack.tools.timing.charts.window import WindowOptions, choose_task

NO_BUDGET = (
    "no board has a budget: give [board.<name>.budget], or --set board.<name>.budget.process_ms=1"
)


class Subject(NamedTuple):
    """The config or the run that a chart shows.

    Attributes:
        config: Config of the rack.
        layout: Layout of its segment.
        run: The run. None for a config.
        folder: Folder for the pictures.
    """

    config: RackConfig
    layout: Layout
    run: TracedRun | None
    folder: Path


def find_subject(text: str, settings: Sequence[str], out: Path | None) -> Subject:
    """Return the run or the config that a chart is to show.

    Args:
        text: Folder of a run, or else the name or path of a config.
        settings: Changes to the config, as for `--set`.
        out: Folder for the pictures. None for the default.

    Raises:
        Failure: If there is no such folder, or settings are given for a run.
        ConfigError: If the config is not valid.
    """
    path = Path(text)
    if path.is_dir() and ("/" in text or (path / "cycles.parquet").is_file()):
        if settings:
            raise Failure(f"--set {settings[0]}: the config of a run cannot be changed: {text}", 2)
        run = TracedRun(Recording(path))
        return Subject(run.config, run.recording.layout, run, out or path)
    if "/" in text and not path.exists():
        raise Failure(f"{text}: there is no run folder and no config of this name", 2)
    config = load(text, settings)
    return Subject(config, resolve_layout(config), None, out or RUNS / f"{config.name}-gantt")


class Gantt(NamedTuple):
    """Panels of one window of time, with notes. The measurement precedes the schedule."""

    rack: str
    panels: tuple[Panel, ...]
    notes: tuple[str, ...]
    column_ns: int

    @property
    def span_count(self) -> int:
        """Number of spans to draw."""
        return sum(len(panel.chart.spans) for panel in self.panels)

    def format_text(self) -> str:
        """Format the chart as text."""
        panels = [
            f"{self.rack}: " + "\n".join(format_panel(panel, self.column_ns))
            for panel in self.panels
        ]
        return "\n\n".join([*panels, *self.notes])

    def to_document(self) -> Document:
        """Convert the chart to plain data."""
        panels = [panel.to_document() for panel in self.panels]
        return {"rack": self.rack, "panels": panels, "notes": list(self.notes)}

    def save_pictures(self, folder: Path) -> list[Path]:
        """Draw the chart into an existing folder, and return the paths of the pictures."""
        # Import this only for pictures, because matplotlib takes a second.
        from rack.tools.timing.charts.picture import save_picture

        return save_picture(self.panels, self.rack, folder / "gantt")


def build_gantt(
    subject: Subject,
    options: WindowOptions,
    progress: Callable[[float], None],
) -> Gantt:
    """Build the chart of a subject.

    Args:
        subject: Config or run.
        options: Window that the user asked for.
        progress: Receives the fraction of a run that has been read.

    Raises:
        Failure: If the subject has neither a run in real time nor a budget, or if the window cannot
            be shown.
    """
    name = subject.config.name
    run = subject.run
    panels: list[Panel] = []
    notes: list[str] = []
    schedule = Schedule(subject.config, subject.layout) if read_budgets(subject.config) else None
    if run is not None and not subject.config.is_lockstep:
        task = choose_task(run.tasks)
        start, end = options.choose_window(task, run.end_ns, run.find_middle_ns(task))
        panels.append(run.build_panel(start, end, progress))
        if schedule is None:
            notes.append(f"no schedule: {NO_BUDGET}")
        else:
            schedule.move_to_cores(run.recording.layout)
    else:
        no_run = f"{name} ran in lockstep: time stood still while its tasks computed"
        if schedule is None:
            raise Failure(f"{name}: {NO_BUDGET}" if run is None else f"{no_run}; {NO_BUDGET}", 2)
        if run is not None:
            notes.append(f"{no_run}; only the schedule is shown")
        start, end = options.choose_window(
            choose_task(schedule.tasks), None, 0, schedule.default_length_ns
        )
    if schedule is not None:
        panels.append(schedule.build_panel(start, end))
    shortest_ns = None if schedule is None else schedule.shortest_ns
    return Gantt(name, tuple(panels), tuple(notes), choose_column_ns(end - start, shortest_ns))
