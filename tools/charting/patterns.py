"""Patterns: the order of unit functions in the cycles of a plan, as the paper writes it: "R X W P | R X W P U -"."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

from rack.levels.timing.schedule import Chart, Span
from rack.levels.timing.tasks import Unit
from rack.tools.charting.lanes import Lane

IDLE = "-"
SHORT = 0.02
"""Part of a cycle below which what is measured may be a remnant: of a late wake-up, of what was cut in two."""
REMNANT = 0.25
"""Part of what a unit function takes in the median: a remnant is shorter than that too, and is not told."""
GAP = 0.1
"""Part of a cycle below which a measured gap is not told: waking up takes its time, and is no idleness."""


class Patterns(NamedTuple):
    """How often each pattern occurred in a lane: in the cycles of one plan, and in a cycle in which there was none."""

    plans: Counter[str]
    cycles: Counter[str]

    @classmethod
    def none(cls) -> Patterns:
        """Return a count of nothing."""
        return cls(Counter(), Counter())

    def add(self, other: Patterns) -> None:
        """Count those of another stretch of time too."""
        self.plans.update(other.plans)
        self.cycles.update(other.cycles)


@dataclass(frozen=True)
class Detail:
    """The longest stretches that are not told, ns: of each unit function, and of nobody."""

    short_ns: Mapping[Unit, int] = field(default_factory=dict)
    gap_ns: int = 0

    @classmethod
    def measured(cls, lane: Lane, median_ns: Mapping[Unit, int]) -> Detail:
        """Return what is left out of the measured patterns of a lane, by what its unit functions take."""
        longest = round(SHORT * lane.cycle_ns)
        short = {unit: min(longest, round(REMNANT * median)) for unit, median in median_ns.items()}
        if lane.is_tight:
            # Its plan lies in its own memory: reading it is no communication, unless it takes long.
            short[Unit.EXCHANGE] = longest
        return cls(short, round(GAP * lane.cycle_ns))


def patterns(chart: Chart, lane: Lane, start_ns: int, end_ns: int, detail: Detail) -> Patterns:
    """Return the patterns of a lane that began from `start_ns` to `end_ns`, those of a plan with " | " between cycles.

    `chart` must reach beyond `end_ns` by a slice.
    """
    counted = Patterns.none()
    spans = _by_cycle([span for span in chart.spans if span.core == lane.core], lane.cycle_ns)
    for start, cycles, is_plan in _stretches(chart, lane, start_ns, end_ns):
        first = start // lane.cycle_ns
        of_cycles = [spans[first + cycle] for cycle in range(cycles)]
        if lane.executor is None:
            # A planner on a processor of its own has no cycles but its plans.
            of_cycles = [[span for spans_of_cycle in of_cycles for span in spans_of_cycle]]
        length = cycles * lane.cycle_ns // len(of_cycles)
        orders = (_order(found, lane, start + at * length, length, detail) for at, found in enumerate(of_cycles))
        (counted.plans if is_plan else counted.cycles)[" | ".join(orders)] += 1
    return counted


def _by_cycle(spans: Sequence[Span], cycle_ns: int) -> dict[int, list[Span]]:
    """Return the spans that lie in each cycle, or reach into it."""
    found: dict[int, list[Span]] = defaultdict(list)
    for span in spans:
        for cycle in range(span.start_ns // cycle_ns, (span.end_ns - 1) // cycle_ns + 1):
            found[cycle].append(span)
    return found


def _stretches(chart: Chart, lane: Lane, start_ns: int, end_ns: int) -> Iterator[tuple[int, int, bool]]:
    """Yield start and number of cycles of every plan, and of the single cycles in which none was; which it is."""
    slices = lane.slice_ns // lane.cycle_ns
    plans = {job.release_ns for job in chart.jobs if lane.planner and job.task == lane.planner}
    planned = {plan + at * lane.cycle_ns for plan in plans for at in range(slices)}
    for at in range(-(-start_ns // lane.cycle_ns) * lane.cycle_ns, end_ns, lane.cycle_ns):
        if at in plans:
            yield at, slices, True
        elif at not in planned and lane.executor is not None:
            yield at, 1, False


def _order(spans: Sequence[Span], lane: Lane, start_ns: int, length_ns: int, detail: Detail) -> str:
    """Return the order of the unit functions from `start_ns` on, as in "R X W P -"."""
    stretches: list[tuple[Unit | None, int]] = []
    busy_until = start_ns
    for span in sorted(spans, key=lambda span: span.start_ns):
        start, end = max(span.start_ns, start_ns), min(span.end_ns, start_ns + length_ns)
        if start - busy_until > detail.gap_ns:
            stretches.append((None, start - busy_until))
        if span.task in lane.tasks:
            stretches.append((span.unit, end - start))
        busy_until = max(busy_until, end)
    if start_ns + length_ns - busy_until > detail.gap_ns:
        stretches.append((None, start_ns + length_ns - busy_until))
    # What other boards have cut in pieces counts as a whole.
    wholes = [(unit, sum(ns for _, ns in pieces)) for unit, pieces in groupby(stretches, key=itemgetter(0))]
    told = [unit.value if unit else IDLE for unit, ns in wholes if unit is None or ns > detail.short_ns.get(unit, 0)]
    return " ".join(letter for letter, _ in groupby(told)) or IDLE
