"""Figures 2 to 4 of the paper, run with real processes and computed from budgets.

X is the processor time that the executor takes in each cycle.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from rack.boards.config import RackConfig, load, resolve_layout
from rack.boards.timing.trace_times import select_plans
from rack.tools.lab.reproduction.experiments import storing
from rack.tools.lab.reproduction.experiments.experiment import ChartedRecord, Experiment, Workshop
from rack.tools.timing.charts.letters import choose_column_ns, format_panel
from rack.tools.timing.charts.measured import TracedRun
from rack.tools.timing.charts.panel import JobCount, Panel
from rack.tools.timing.charts.scheduled import Schedule

# The paper's X, ms: "will range from 1 to 3 ms".
MIN_X_MS = 1.0
MAX_X_MS = 3.0
SECONDS = 3.0
MAX_ATTEMPTS = 3
"""Maximum number of runs of a figure until no cycle of its executor is disturbed."""
LAUNCH_S = 2.5
# Tasks of these racks.
LEVEL = "level"
PLANNER = "level.planner"
STORING_MS = 30.0
"""Approximate time to store a block, ms."""
MS = 1e-6


@dataclass(frozen=True)
class FigureRack:
    """A figure of the paper.

    Attributes:
        config: Name of its config.
        cycles: Number of cycles to draw.
        label: Name of its experiment.
        settings: Changes to the config.
    """

    config: str
    cycles: int
    label: str
    settings: tuple[str, ...] = ()

    @cached_property
    def rack(self) -> RackConfig:
        """The loaded config."""
        return load(self.config, self.settings)

    @cached_property
    def schedule(self) -> Schedule:
        """Schedule computed from the budget."""
        return Schedule(self.rack, resolve_layout(self.rack))

    @property
    def experiment(self) -> Experiment[FigureRun]:
        """Experiment that runs the figure with real processes."""
        return Experiment(
            self.label,
            f"{self.label} by real processes",
            SECONDS + LAUNCH_S,
            FigureRun,
            partial(_measure_figure, self),
            cores=2 if self.rack.board[LEVEL].coupling == "loose" else 1,
        )

    @property
    def window_ns(self) -> int:
        """Duration that the charts show, in ns."""
        return self.cycles * self.rack.find_period(LEVEL) * self.rack.clock_ns

    def build_panel(self) -> Panel:
        """Compute the schedule of the figure as a panel that begins with the first cycle."""
        return self.schedule.build_panel(0, self.window_ns)

    def format_letters(self, panel: Panel) -> str:
        """Format a panel of this figure in letters, as the paper draws it."""
        column_ns = choose_column_ns(self.window_ns, self.schedule.shortest_ns)
        return "\n".join((self.label, *format_panel(panel, column_ns)))


def build_settings(name: str, process_ms: float) -> tuple[str, ...]:
    """Return the settings that change X of a figure's executor.

    They change both the budget and the parameters of the board.

    Args:
        name: Name of the config.
        process_ms: X, the processor time of the executor in a cycle, ms.
    """
    board = load(name).board[LEVEL]
    assert board.budget is not None, "every figure has a budget"
    fixed_ms = board.budget.process_ms - board.params["process_ms"]
    computed_ms = max(process_ms - fixed_ms, 0.0)
    return (
        f"board.{LEVEL}.budget.process_ms={process_ms:g}",
        f"board.{LEVEL}.params.process_ms={computed_ms:.6g}",
    )


def _build_figure_with_x(name: str, cycles: int, process_ms: float) -> FigureRack:
    """Build a variant of a figure in which X is `process_ms`."""
    label = f"{name}-x{process_ms:g}"
    return FigureRack(name, cycles, label, build_settings(name, process_ms))


def _build_storing_figure(task: str, key: str) -> FigureRack:
    """Build a variant of figure 2 in which a task stores data.

    Args:
        task: "planner" or "executor".
        key: Key of the budget that contains the time for storing.
    """
    settings = (
        f'board.{LEVEL}.{task}="{storing.__name__}:Storing{task.capitalize()}"',
        f"board.{LEVEL}.budget.{key}={STORING_MS}",
        # The kernel reserves 5 % of each second for ordinary scheduling. A planner that always has
        # work would exhaust the rest, and the kernel would stop the executor as well.
        f"board.{LEVEL}.planner_priority=0",
    )
    return FigureRack("fig2", 6, f"fig2-{task}", settings)


FIG2 = FigureRack("fig2", 2, "fig2")
FIG3 = FigureRack("fig3", 3, "fig3")
FIG4 = FigureRack("fig4", 2, "fig4")
OVERLOAD = FigureRack("fig4-overload", 3, "fig4-overload")
BUFFERED = FigureRack(
    "fig4", 2, "fig4-double-buffer", (f'protocol.mailbox={{ "{LEVEL}.plan" = "double-buffer" }}',)
)
IN_BACKGROUND = _build_storing_figure("planner", "plan_ms")
IN_CYCLE = _build_storing_figure("executor", "process_ms")
SHORT_2 = _build_figure_with_x("fig2", 2, MIN_X_MS)
LONG_2 = _build_figure_with_x("fig2", 3, MAX_X_MS)
SHORT_3 = _build_figure_with_x("fig3", 3, MIN_X_MS)


@dataclass(frozen=True)
class FigureRun(ChartedRecord):
    """A run of a figure.

    Attributes:
        tasks: Dictionary from tasks to their numbers of jobs and late jobs.
        met: Number of updates of the plan during which the executor was released.
        preempted: Number of updates of the plan during which the executor began.
    """

    tasks: dict[str, JobCount]
    met: int
    preempted: int

    def compute_late_share(self, task: str) -> float:
        """Return the fraction of a task's jobs that were late. 1 if it had no jobs."""
        count = self.tasks[task]
        return count.late / count.jobs if count.jobs else 1.0


def _measure_figure(figure: FigureRack, workshop: Workshop) -> FigureRun:
    """Run a figure, and return its counts and a chart of the middle of the run."""
    run = _find_least_disturbed_run(figure, workshop)
    start_ns = run.find_middle_ns(next(task for task in run.tasks if task.name == PLANNER))
    executor = run.recording.read_trace(LEVEL)
    updates = select_plans(run.recording.read_trace(PLANNER))
    panel = run.build_panel(start_ns, start_ns + figure.window_ns, lambda part: None)
    return FigureRun(
        tasks=dict(panel.counts),
        met=_count_updates_around(updates, executor["release_ns"]),
        preempted=_count_updates_around(updates, executor["start_ns"]),
        chart=figure.format_letters(panel),
    )


def _count_updates_around(updates: np.ndarray, times_ns: np.ndarray) -> int:
    """Return the number of plan updates during which at least one of `times_ns` occurred."""
    first, last = (np.searchsorted(times_ns, updates[field]) for field in ("process_ns", "end_ns"))
    return int(np.count_nonzero(last > first))


def _find_least_disturbed_run(figure: FigureRack, workshop: Workshop) -> TracedRun:
    """Return the run with the fewest late cycles of the executor.

    A run with late cycles is repeated, because other programs may have taken cores away. A figure
    whose schedule already makes the executor late is run only once.
    """
    runs: list[tuple[int, TracedRun]] = []
    is_late_by_schedule = bool(figure.build_panel().chart.list_late_jobs(LEVEL))
    for attempt in range(1, MAX_ATTEMPTS + 1):
        config = workshop.load_config(figure.config, figure.settings)
        run = TracedRun(workshop.run(f"{figure.label}-{attempt}", config, SECONDS).recording)
        late = len(run.build_chart(0, run.end_ns).list_late_jobs(LEVEL))
        runs.append((late, run))
        if is_late_by_schedule or not late:
            break
    return min(runs, key=lambda pair: pair[0])[1]
