"""A Gantt chart of a config or of a run, as text, as plain data and as a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from rack.backplane.layout import Layout
from rack.boards.config import RackConfig, load, read_budgets, resolve_layout
from rack.boards.timing.tasks import TimedTask
from rack.tools.console.answer import Document, Failure
from rack.tools.console.tables import format_ms
from rack.tools.launch.folder import RUNS
from rack.tools.recording.recording import Recording
from rack.tools.timing.charts.letters import choose_column_ns, format_panel
from rack.tools.timing.charts.measured import TracedRun
from rack.tools.timing.charts.panel import Panel
from rack.tools.timing.charts.scheduled import Schedule

NO_BUDGET = (
    "no board has a budget: give [board.<name>.budget], or --set board.<name>.budget.process_ms=1"
)
DEFAULT_SLICES = 2
"""Number of plans in a default chart."""
MAX_DEFAULT_CYCLES = 48
"""Maximum number of the fastest task's cycles in a default chart."""
MAX_CYCLES = 2000
"""Maximum number of a level's cycles in any chart."""


class WindowOptions(NamedTuple):
    """Window that the user asked for, in ns. None for a limit that is not given."""

    from_ns: int | None = None
    to_ns: int | None = None

    def choose_window(
        self, task: TimedTask, extent_ns: int | None, start_ns: int, length_ns: int | None = None
    ) -> tuple[int, int]:
        """Return the start and the end of the window, in ns.

        Args:
            task: Task that determines the window. It shows at most `MAX_CYCLES` of its cycles.
            extent_ns: Length of the run, ns. None for a schedule, which has no end.
            start_ns: Default start, ns.
            length_ns: Default length, ns. None for two plans of the task.

        Raises:
            Failure: If the window is empty, too long, or outside the run.
        """
        start = start_ns if self.from_ns is None else self.from_ns
        end = (
            start + (length_ns or DEFAULT_SLICES * task.period_ns)
            if self.to_ns is None
            else self.to_ns
        )
        if extent_ns is not None:
            if start >= extent_ns or (end > extent_ns and self.to_ns is not None):
                raise Failure(
                    f"{_format_window(start, end)}: is outside the run, which lasts from 0 to"
                    f" {format_ms(extent_ns)} ms",
                    2,
                )
            end = min(end, extent_ns)
        if start >= end:
            raise Failure(f"{_format_window(start, end)}: --to-ms must be later than --from-ms", 2)
        if end - start > (longest_ns := MAX_CYCLES * task.every_ns):
            raise Failure(
                f"{_format_window(start, end)}: a chart shows at most {MAX_CYCLES} cycles of"
                f" '{task.board}', {format_ms(longest_ns)} ms",
                2,
            )
        return start, end


def choose_task(tasks: Sequence[TimedTask]) -> TimedTask:
    """Return the task whose cycles determine the default window.

    It is the slowest task that fits into a chart, if possible a tightly coupled planner.
    """
    tasks = [task for task in tasks if task.role != "clock"]
    fastest = min(task.every_ns for task in tasks)
    cores = {(task.board, task.core) for task in tasks if task.role == "executor"}
    shown = [
        task for task in tasks if DEFAULT_SLICES * task.period_ns <= MAX_DEFAULT_CYCLES * fastest
    ]
    tight = [task for task in shown if task.role == "planner" and (task.board, task.core) in cores]
    return max(
        tight or shown or [min(tasks, key=lambda task: task.period_ns)],
        key=lambda task: task.period_ns,
    )


def _format_window(start_ns: int, end_ns: int) -> str:
    """Format the start and the end of a window in ms."""
    return f"{format_ms(start_ns)} to {format_ms(end_ns)} ms"


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
    config = load(text, settings)
    return Subject(config, resolve_layout(config), None, out or RUNS / f"{config.name}-gantt")


class Gantt(NamedTuple):
    """Panels of one window of time, with notes. The measurement precedes the schedule."""

    rack: str
    panels: tuple[Panel, ...]
    notes: tuple[str, ...]
    column_ns: int

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
    if run is not None and subject.config.takes_time:
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
    shortest_ns = 0 if schedule is None else schedule.shortest_ns
    return Gantt(name, tuple(panels), tuple(notes), choose_column_ns(end - start, shortest_ns))
