"""Lanes, the rows of a Gantt chart, and their patterns.

A pattern is the order of unit functions in the cycles of a plan, written as in the paper:
"R X W P | R X W P U -".
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
"""Start and end of a stretch of time, ns."""
IDLE = "-"
MAX_REMNANT_CYCLE_FRACTION = 0.02
"""Fraction of a cycle below which a measured stretch may be a remnant.

Remnants come from a late wake-up, or from a stretch that was cut in two.
"""
MAX_REMNANT_MEDIAN_FRACTION = 0.25
"""Fraction of the median of its unit function below which such a stretch is left out."""
MAX_GAP_CYCLE_FRACTION = 0.1
"""Fraction of a cycle below which a measured gap is left out.

Waking up takes time and does not mean that the core is idle.
"""


@dataclass(frozen=True)
class Lane:
    """A row of a Gantt chart: the tasks of one board on one core.

    It contains an executor, with its planner if they are tightly coupled, or only a planner.

    Attributes:
        core: Core of the tasks.
        board: Name of the board.
        executor: Name of the executor. None in the lane of a planner.
        planner: Name of the planner. None if it has another lane, or if there is none.
        priority: Highest priority of the tasks.
        cycle_ns: Cycle of the level, ns.
        slice_ns: Time for one plan, or for one cycle if there is no planner, ns.
        phase_ns: Start of the first cycle, ns.
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
        """Names of the tasks."""
        return tuple(name for name in (self.executor, self.planner) if name is not None)

    @property
    def name(self) -> str:
        """Name of the executor, or else of the planner."""
        return self.tasks[0]

    def list_cycle_starts(self, since_ns: int, until_ns: int) -> range:
        """Return the starts of the cycles that begin at `since_ns` or later, before `until_ns`."""
        first_ns = since_ns + (self.phase_ns - since_ns) % self.cycle_ns
        return range(first_ns, until_ns, self.cycle_ns)

    @property
    def title(self) -> str:
        """Core and name for the chart."""
        return f"core {self.core}  {self.name}"

    @property
    def is_tight(self) -> bool:
        """Whether a planner shares the core with its executor."""
        return self.executor is not None and self.planner is not None


def build_lanes(tasks: Sequence[TimedTask]) -> tuple[Lane, ...]:
    """Return the lanes of `tasks`, sorted by core and then by descending priority."""
    lanes = []
    for core, board in dict.fromkeys((task.core, task.board) for task in tasks):
        board_tasks = [task for task in tasks if (task.core, task.board) == (core, board)]
        planner = next((task for task in board_tasks if task.role == "planner"), None)
        lanes.append(
            Lane(
                core=core,
                board=board,
                executor=next((task.name for task in board_tasks if task.role != "planner"), None),
                planner=None if planner is None else planner.name,
                priority=max(task.priority for task in board_tasks),
                cycle_ns=board_tasks[0].every_ns,
                slice_ns=(planner or board_tasks[0]).period_ns,
                phase_ns=board_tasks[0].phase_ns,
            )
        )
    return tuple(sorted(lanes, key=lambda lane: (lane.core, -lane.priority, lane.cycle_ns)))


class Patterns(NamedTuple):
    """Number of occurrences of each pattern in a lane.

    Attributes:
        plans: Counts of the patterns of plans, each over all cycles of the plan.
        cycles: Counts of the patterns of single cycles without a plan.
    """

    plans: Counter[str]
    cycles: Counter[str]


@dataclass(frozen=True)
class PatternDetail:
    """Limits, in ns. Stretches up to these lengths are left out of patterns.

    Attributes:
        short_ns: Dictionary from each unit function to its limit.
        gap_ns: Limit for stretches in which the core is idle.
    """

    short_ns: Mapping[Unit, int] = field(default_factory=dict)
    gap_ns: int = 0

    @classmethod
    def from_medians(cls, lane: Lane, median_ns: Mapping[Unit, int]) -> PatternDetail:
        """Derive the limits for measured patterns from the median times of the unit functions."""
        longest = round(MAX_REMNANT_CYCLE_FRACTION * lane.cycle_ns)
        short = {
            unit: min(longest, round(MAX_REMNANT_MEDIAN_FRACTION * median))
            for unit, median in median_ns.items()
        }
        if lane.is_tight:
            # Reading a plan from local memory does not count as communication unless it takes long.
            short[Unit.EXCHANGE] = longest
        return cls(short, round(MAX_GAP_CYCLE_FRACTION * lane.cycle_ns))


def count_patterns(chart: Chart, lane: Lane, within: Stretch, detail: PatternDetail) -> Patterns:
    """Count the patterns of a lane that began within a stretch.

    The cycles of a plan are separated by " | ".

    Args:
        chart: Chart, which must extend beyond the stretch by one slice.
        lane: Lane whose patterns are counted.
        within: Start and end of the stretch, ns.
        detail: Limits up to which stretches are left out.
    """
    counted = Patterns(Counter(), Counter())
    spans = [span for span in chart.spans if span.core == lane.core]
    starts = [span.start_ns for span in spans]
    # The running maximum sorts the ends, which may be unsorted under ordinary scheduling.
    ends = list(accumulate((span.end_ns for span in spans), max))
    for start, cycles, is_plan in _list_plans_and_cycles(chart, lane, within):
        end = start + cycles * lane.cycle_ns
        # A planner on a separate processor has no cycles other than its plans.
        length = lane.cycle_ns if lane.executor is not None else end - start
        orders = []
        for begin in range(start, end, length):
            candidates = spans[bisect_right(ends, begin) : bisect_left(starts, begin + length)]
            overlapping = [span for span in candidates if span.end_ns > begin]
            orders.append(_format_order(overlapping, lane, (begin, begin + length), detail))
        counter = counted.plans if is_plan else counted.cycles
        counter[" | ".join(orders)] += 1
    return counted


def _list_plans_and_cycles(
    chart: Chart, lane: Lane, within: Stretch
) -> Iterator[tuple[int, int, bool]]:
    """Yield the plans, and the cycles without a plan, that begin within a stretch.

    Each is a tuple of its start in ns, its number of cycles, and whether it is a plan.
    """
    slices = lane.slice_ns // lane.cycle_ns
    plans = {job.release_ns for job in chart.jobs if lane.planner and job.task == lane.planner}
    planned = {plan + start_ns * lane.cycle_ns for plan in plans for start_ns in range(slices)}
    for start_ns in lane.list_cycle_starts(*within):
        if start_ns in plans:
            yield start_ns, slices, True
        elif start_ns not in planned and lane.executor is not None:
            yield start_ns, 1, False


def _format_order(spans: Sequence[Span], lane: Lane, within: Stretch, detail: PatternDetail) -> str:
    """Format the order of the unit functions within a stretch, as in "R X W P -".

    Args:
        spans: Spans in the stretch, in chronological order.
        lane: Lane of the pattern.
        within: Start and end of the stretch, ns.
        detail: Limits up to which stretches are left out.
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
    # A unit function that was interrupted by other boards counts once.
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
