"""Lanes, the rows of a Gantt chart, and their patterns: the order of unit functions in the cycles
of a plan.

A pattern is written as in the paper: "R X W P | R X W P U -".
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, groupby
from operator import itemgetter
from typing import NamedTuple

from rack.boards.timing.schedule import Chart, Span
from rack.boards.timing.tasks import TimedTask, Unit

Stretch = tuple[int, int]
"""Start and end, ns."""
IDLE = "-"
SHORT = 0.02
"""Part of a cycle below which a measured stretch may be a remnant, of a late wake-up or of a
stretch cut in two."""
REMNANT = 0.25
"""Part of the median of a unit function: a remnant is shorter than that too, and left out."""
GAP = 0.1
"""Part of a cycle below which a measured gap is left out: waking up takes time, and is not
idleness."""


@dataclass(frozen=True)
class Lane:
    """A row of a Gantt chart: the tasks of one board on one core.

    That is an executor, with its planner where they are tightly coupled, or a planner alone.
    `cycle_ns` is the level's cycle, `slice_ns` the time for one plan; without a planner, one cycle.
    `phase_ns` is the start of the first cycle.
    """

    core: int
    board: str
    executor: str | None
    planner: str | None
    priority: int
    cycle_ns: int
    slice_ns: int
    phase_ns: int

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names of its tasks."""
        return tuple(name for name in (self.executor, self.planner) if name is not None)

    @property
    def name(self) -> str:
        """Name of the executor; of the planner where it is alone."""
        return self.tasks[0]

    def cycle_from(self, time_ns: int) -> int:
        """Return the start of its first cycle that begins at a time or later."""
        return time_ns + (self.phase_ns - time_ns) % self.cycle_ns

    @property
    def title(self) -> str:
        """Core and name."""
        return f"core {self.core}  {self.name}"

    @property
    def is_tight(self) -> bool:
        """Whether a planner shares the core with its executor."""
        return self.executor is not None and self.planner is not None


def lanes_of(tasks: Sequence[TimedTask]) -> tuple[Lane, ...]:
    """Return the lanes of `tasks`, by core, then by falling priority."""
    lanes = []
    for core, board in dict.fromkeys((task.core, task.board) for task in tasks):
        own = [task for task in tasks if (task.core, task.board) == (core, board)]
        planner = next((task for task in own if task.role == "planner"), None)
        lanes.append(
            Lane(
                core=core,
                board=board,
                executor=next((task.name for task in own if task.role != "planner"), None),
                planner=None if planner is None else planner.name,
                priority=max(task.priority for task in own),
                cycle_ns=own[0].every_ns,
                slice_ns=(planner or own[0]).period_ns,
                phase_ns=own[0].phase_ns,
            )
        )
    return tuple(sorted(lanes, key=lambda lane: (lane.core, -lane.priority, lane.cycle_ns)))


class Patterns(NamedTuple):
    """How often each pattern occurred in a lane: over the cycles of a plan, and in single cycles
    without one.
    """

    plans: Counter[str]
    cycles: Counter[str]

    @classmethod
    def none(cls) -> Patterns:
        """Return a count of nothing."""
        return cls(Counter(), Counter())

    def add(self, other: Patterns) -> None:
        """Add the counts of another stretch of time."""
        self.plans.update(other.plans)
        self.cycles.update(other.cycles)


@dataclass(frozen=True)
class Detail:
    """The longest stretches that patterns leave out, ns: of each unit function, and of an idle
    core.
    """

    short_ns: Mapping[Unit, int] = field(default_factory=dict)
    gap_ns: int = 0

    @classmethod
    def measured(cls, lane: Lane, median_ns: Mapping[Unit, int]) -> Detail:
        """Return the detail of the measured patterns of a lane, from the medians of its unit
        functions.
        """
        longest = round(SHORT * lane.cycle_ns)
        short = {unit: min(longest, round(REMNANT * median)) for unit, median in median_ns.items()}
        if lane.is_tight:
            # Its plan is in its own memory: reading it is not communication, unless it takes long.
            short[Unit.EXCHANGE] = longest
        return cls(short, round(GAP * lane.cycle_ns))


def patterns(chart: Chart, lane: Lane, within: Stretch, detail: Detail) -> Patterns:
    """Return the patterns of a lane that began within a stretch, with " | " between the cycles of a
    plan.

    `chart` must extend beyond the stretch by a slice.
    """
    counted = Patterns.none()
    spans = [span for span in chart.spans if span.core == lane.core]
    starts = [span.start_ns for span in spans]
    # The ends are sorted as well, unless ordinary scheduling has mixed the tasks of a core.
    ends = list(accumulate((span.end_ns for span in spans), max))
    for start, cycles, is_plan in _beginnings(chart, lane, within):
        end = start + cycles * lane.cycle_ns
        # The only cycles of a planner on its own processor are its plans.
        length = lane.cycle_ns if lane.executor is not None else end - start
        orders = []
        for begin in range(start, end, length):
            near = spans[bisect_right(ends, begin) : bisect_left(starts, begin + length)]
            own = [span for span in near if span.end_ns > begin]
            orders.append(_order(own, lane, (begin, begin + length), detail))
        counter = counted.plans if is_plan else counted.cycles
        counter[" | ".join(orders)] += 1
    return counted


def _beginnings(chart: Chart, lane: Lane, within: Stretch) -> Iterator[tuple[int, int, bool]]:
    """Yield start, number of cycles and True for every plan; start, 1 and False for every cycle
    without one.
    """
    slices = lane.slice_ns // lane.cycle_ns
    plans = {job.release_ns for job in chart.jobs if lane.planner and job.task == lane.planner}
    planned = {plan + at * lane.cycle_ns for plan in plans for at in range(slices)}
    for at in range(lane.cycle_from(within[0]), within[1], lane.cycle_ns):
        if at in plans:
            yield at, slices, True
        elif at not in planned and lane.executor is not None:
            yield at, 1, False


def _order(spans: Sequence[Span], lane: Lane, within: Stretch, detail: Detail) -> str:
    """Return the order of the unit functions within a stretch, as in "R X W P -"; `spans` are those
    in it, in the order of time.
    """
    stretches: list[tuple[Unit | None, int]] = []
    busy_until = within[0]
    for span in spans:
        start = max(span.start_ns, within[0])
        end = min(span.end_ns, within[1])
        if start - busy_until > detail.gap_ns:
            stretches.append((None, start - busy_until))
        if span.task in lane.tasks:
            stretches.append((span.unit, end - start))
        busy_until = max(busy_until, end)
    if within[1] - busy_until > detail.gap_ns:
        stretches.append((None, within[1] - busy_until))
    # Pieces of a unit function that other boards have preempted count as one.
    wholes = [
        (unit, sum(ns for _, ns in pieces))
        for unit, pieces in groupby(stretches, key=itemgetter(0))
    ]
    shown = [
        unit.value if unit else IDLE
        for unit, ns in wholes
        if unit is None or ns > detail.short_ns.get(unit, 0)
    ]
    return " ".join(letter for letter, _ in groupby(shown)) or IDLE
