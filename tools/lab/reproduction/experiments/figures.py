"""Figures 2 to 4 of the paper run by real processes, and their planning computed for every X."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from rack.boards.config import RackConfig, load, rack_timing, wire
from rack.boards.config.schema import BudgetConfig
from rack.levels.timing.forecast import Forecast
from rack.levels.timing.trace_times import plans
from rack.tools.lab.reproduction.experiments import storing
from rack.tools.lab.reproduction.experiments.experiment import (
    Experiment,
    Workshop,
    need_real_time,
)
from rack.tools.timing.charts.measured import TracedRun
from rack.tools.timing.charts.panel import Count, Panel
from rack.tools.timing.charts.scheduled import Schedule

LEAST_X = 1.0
MOST_X = 3.0
"""The paper's X, ms: "will range from 1 to 3 ms"."""
SECONDS = 3.0
ATTEMPTS = 3
"""Most runs of a figure, until the cycles of its executor are in time."""
LAUNCH_S = 2.5
LEVEL = "level"
PLANNER = "level.planner"
"""Tasks of these racks."""
STORING_MS = 30.0
"""About how long a block takes to store."""
PARTS = {"planner": "plan_ms", "executor": "process_ms"}
MS = 1e-6


@dataclass(frozen=True)
class FigureRack:
    """A figure of the paper: its config, drawn over so many cycles, with another X, ms, or another
    protocol for the plan, if given; or with a task, "planner" or "executor", that stores data."""

    config: str
    cycles: int
    process_ms: float | None = None
    protocol: str = ""
    stores: str = ""

    @property
    def label(self) -> str:
        """Name of its experiment and of its pictures."""
        if variant := self.protocol or self.stores:
            return f"{self.config}-{variant}"
        return self.config if self.process_ms is None else f"{self.config}-x{self.process_ms:g}"

    @property
    def settings(self) -> tuple[str, ...]:
        """The settings for this X, for its plan this way, or with which a task stores."""
        if self.stores:
            level = f"board.{LEVEL}"
            task = f'{level}.{self.stores}="{storing.__name__}:Storing{self.stores.capitalize()}"'
            budget = f"{level}.budget.{PARTS[self.stores]}={STORING_MS}"
            # A planner that always has work would take what the kernel keeps from real-time
            # priorities, 5 % of each second, for which it stops the executor, too.
            return task, budget, f"{level}.planner_priority=0"
        if self.protocol:
            return (f'protocol.mailbox={{ "{LEVEL}.plan" = "{self.protocol}" }}',)
        return () if self.process_ms is None else settings_of(self.config, self.process_ms)

    def loaded(self) -> RackConfig:
        """Return the config."""
        return load(self.config, self.settings)

    @property
    def experiment(self) -> Experiment[FigureRun]:
        """Its run by real processes."""
        lasts_s = SECONDS + LAUNCH_S
        about = f"{self.label} by real processes"
        return Experiment(self.label, about, lasts_s, FigureRun, partial(_run, self))

    def schedule(self) -> Schedule:
        """Return the schedule that follows from its budget."""
        config = self.loaded()
        return Schedule(config, wire(config), {})

    def panel(self) -> Panel:
        """Return this schedule, from the first cycle on."""
        return self.schedule().panel(0, self.window_ns)

    @property
    def window_ns(self) -> int:
        """The time that its charts show."""
        config = self.loaded()
        return self.cycles * config.every(LEVEL) * config.clock_ns


FIG2 = FigureRack("fig2", 2)
FIG3 = FigureRack("fig3", 3)
FIG4 = FigureRack("fig4", 2)
OVERLOAD = FigureRack("fig4-overload", 3)
BUFFERED = FigureRack("fig4", 2, protocol="double-buffer")
BEHIND = FigureRack("fig2", 6, stores="planner")
IN_LINE = FigureRack("fig2", 6, stores="executor")
SHORT_2 = FigureRack("fig2", 2, LEAST_X)
LONG_2 = FigureRack("fig2", 3, MOST_X)
SHORT_3 = FigureRack("fig3", 3, LEAST_X)


def budget_of(config: RackConfig) -> BudgetConfig:
    """Return the budget of a figure's only level."""
    budget = config.board[LEVEL].budget
    assert budget is not None, "every figure has a budget"
    return budget


def settings_of(name: str, process_ms: float) -> tuple[str, ...]:
    """Return the settings with which the executor of a figure takes this X, ms, in its budget and
    on its board."""
    config = load(name)
    own_ms = budget_of(config).process_ms - config.board[LEVEL].params["process_ms"]
    computed_ms = max(process_ms - own_ms, 0.0)
    return (
        f"board.{LEVEL}.budget.process_ms={process_ms:g}",
        f"board.{LEVEL}.params.process_ms={computed_ms:.6g}",
    )


@dataclass(frozen=True)
class FigureRun:
    """A run of a figure: jobs of its tasks.

    Releases of the executor `met` so many updates of the plan; it began within so many,
    `preempted`.
    """

    tasks: dict[str, Count]
    met: int
    preempted: int
    pictures: dict[str, Path]

    def late(self, task: str) -> float:
        """Return the part of a task's jobs that were late."""
        count = self.tasks[task]
        return count.late / count.jobs if count.jobs else 1.0


def _run(figure: FigureRack, workshop: Workshop) -> FigureRun:
    from rack.tools.timing.charts.picture import save

    is_loose = figure.loaded().board[LEVEL].coupling == "loose"
    need_real_time(cores=2 if is_loose else 1)
    run = _least_disturbed(figure, workshop)
    start = run.middle_ns(next(task for task in run.tasks if task.name == PLANNER))
    executor = run.recording.trace(LEVEL)
    updates = plans(run.recording.trace(PLANNER))
    panel = run.panel(start, start + figure.window_ns, lambda part: None)
    drawn = save([panel], f"{figure.label}: a run", workshop.picture(f"{figure.label}-run"))
    return FigureRun(
        tasks=dict(panel.counts),
        met=_within(updates, executor["release_ns"]),
        preempted=_within(updates, executor["start_ns"]),
        pictures={"measured": workshop.shown(drawn)},
    )


def _within(updates: np.ndarray, times_ns: np.ndarray) -> int:
    """Return how many updates of a plan have one of these times in them."""
    begun, ended = (np.searchsorted(times_ns, updates[at]) for at in ("process_ns", "end_ns"))
    return int(np.count_nonzero(ended > begun))


def _least_disturbed(figure: FigureRack, workshop: Workshop) -> TracedRun:
    """Return the run in which the fewest of the executor's cycles were late: other programs take
    cores away.

    An executor that is late by its own schedule runs once.
    """
    tried: list[tuple[int, TracedRun]] = []
    is_late = bool(figure.panel().chart.late(LEVEL))
    for attempt in range(1, ATTEMPTS + 1):
        config = workshop.config(figure.config, figure.settings)
        run = TracedRun(workshop.run(f"{figure.label}-{attempt}", config, SECONDS).recording)
        late = len(run.chart(0, run.end_ns).late(LEVEL))
        tried.append((late, run))
        if is_late or not late:
            break
    return min(tried, key=lambda one: one[0])[1]


@dataclass(frozen=True)
class Planning:
    """A figure with one X, ms, and the time that its planner has.

    `each_ms` is left for P in every cycle if U too is in every cycle, as the pattern "RXWPU" reads;
    `cycles_each` are the cycles until P is done that way, None if it never is. `once_ms` is left
    for P and U together, U once a plan; `cycles_once` are those cycles. `permitted` are the cycles
    that a plan may take. `failing` names the equations that fail. `idle_ms` is left of an
    executor's cycle. `pattern` is the schedule's over the cycles of a plan, and `in_time` says
    whether all its cycles and plans are in time.
    """

    process_ms: float
    each_ms: float
    cycles_each: int | None
    once_ms: float
    cycles_once: int | None
    permitted: int
    failing: tuple[str, ...]
    idle_ms: float
    pattern: str
    in_time: bool


def planning(name: str, process_ms: float) -> Planning:
    """Return what the timing model says of a figure with this X, ms."""
    config = load(name, settings_of(name, process_ms))
    layout = wire(config)
    rack = rack_timing(config, layout)
    level = rack.level(LEVEL)
    panel = Schedule(config, layout, {}).panel(0, level.cycle_ns)
    patterns = panel.patterns[LEVEL]
    once_ns = level.cycle_ns if level.coupling == "loose" else level.residual_ns
    each_ns = once_ns - level.update_ns
    plan_ns = level.plan_ns or 0
    return Planning(
        process_ms=process_ms,
        each_ms=each_ns * MS,
        cycles_each=_cycles(plan_ns, each_ns),
        once_ms=once_ns * MS,
        cycles_once=_cycles(plan_ns + level.update_ns, once_ns),
        permitted=level.within_cycles or 0,
        failing=tuple(dict.fromkeys(v.equation for v in Forecast.of(rack).verdicts if not v.holds)),
        idle_ms=level.residual_ns * MS,
        pattern=(patterns.plans or patterns.cycles).most_common(1)[0][0],
        in_time=not any(count.late for count in panel.counts.values()),
    )


def _cycles(work_ns: int, left_ns: int) -> int | None:
    """Return the cycles in which work is done, with so much time left for it in each; None: it
    never is."""
    return -(-work_ns // left_ns) if left_ns > 0 else None


def sweep(name: str, values: Iterable[float]) -> list[Planning]:
    """Return a figure with every one of these X, ms."""
    return [planning(name, value) for value in values]
