"""Figures of a campaign by kind of fault: shares with confidence intervals, rates and delays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import exp, lgamma, log, sqrt
from statistics import median

from rack.boards.faults.kind import KINDS
from rack.tools.faults.ending import EXTERNAL, find_record
from rack.tools.faults.judge import Judgement


@dataclass(frozen=True)
class FaultCounts:
    """Numbers of faults by outcome. Only faults that must be detected are counted."""

    drawn: int
    injected: int
    detected: int
    missed: int
    not_struck: int
    within_bound: int
    reacted_to: int
    recovered: int
    latched: int


@dataclass(frozen=True)
class Spread:
    """Median and maximum of some values."""

    median: float
    max: float


@dataclass(frozen=True)
class KindFigures(FaultCounts):
    """Figures of one kind.

    Attributes:
        wilson: Bounds of the 95 % confidence intervals of shares of the injected faults. None if
            none were injected.
        bound: Detection bound as text.
        cycles: Detection delays in cycles of the task.
        ticks: Detection delays in ticks.
        bound_ticks: Smallest and largest bound in ticks.
        part_of_bound: Detection delays as fractions of their bounds.
        ms: Detection delays in ms.
        reactions: Codes of the reactions.
        recovery_ms: Recovery times in ms of simulated time.
    """

    wilson: dict[str, tuple[float, float] | None]
    bound: str
    cycles: Spread | None
    ticks: Spread | None
    bound_ticks: dict[str, int] | None
    part_of_bound: Spread | None
    ms: Spread | None
    reactions: list[str]
    recovery_ms: Spread | None


@dataclass(frozen=True)
class EventRate:
    """Rate of events per hour, and the rate below which it lies with 95 % confidence."""

    an_hour: float
    below: float


@dataclass(frozen=True)
class SizePoint:
    """A point of a curve of size against delay. The delay is None for an undetected fault."""

    size: float
    joint: str
    delay_ms: float | None
    delay: int | None


@dataclass(frozen=True)
class SizeCurve:
    """A curve of size against delay. Faults must be detected from the size `judged_from`."""

    judged_from: float
    curve: list[SizePoint]


def compute_by_kind(faults: Sequence[Judgement], clock_ns: int) -> dict[str, KindFigures]:
    """Return a dictionary from each kind to its figures, in the order of `KINDS`.

    Only faults that must be detected are counted.
    """
    judged = [fault for fault in faults if fault.is_judged]
    kinds = dict.fromkeys([*KINDS.names, EXTERNAL])
    grouped = {kind: [fault for fault in judged if fault.kind == kind] for kind in kinds}
    return {
        kind: _compute_figures(kind, group, clock_ns) for kind, group in grouped.items() if group
    }


Z95 = 1.959964
"""Number of standard deviations within which 95 % of a normal distribution lie."""
RULE_95 = 0.05


def compute_wilson_interval(count: int, total: int) -> tuple[float, float] | None:
    """Return the bounds of Wilson's 95 % interval for a share. None if `total` is 0.

    Args:
        count: Number of cases that have the property.
        total: Number of all cases.
    """
    if not total:
        return None
    share = count / total
    z2 = Z95**2
    middle = (share + z2 / (2 * total)) / (1 + z2 / total)
    half = Z95 / (1 + z2 / total) * sqrt(share * (1 - share) / total + z2 / (4 * total * total))
    return max(0.0, round(middle - half, 6)), min(1.0, round(middle + half, 6))


def compute_rate(count: int, seconds: float) -> EventRate | None:
    """Return the hourly rate of `count` events in `seconds` of time. None if `seconds` is 0.

    The upper bound is the rate at which `count` or fewer events have a probability of 5 %
    (Poisson).
    """
    if seconds <= 0.0:
        return None
    low = float(count)
    high = count + 10.0 + 5.0 * sqrt(count)
    for _ in range(60):
        middle = 0.5 * (low + high)
        chance = sum(exp(k * log(middle) - middle - lgamma(k + 1)) for k in range(count + 1))
        if chance > RULE_95:
            low = middle
        else:
            high = middle
    hours = seconds / 3600.0
    return EventRate(round(count / hours, 3), round(high / hours, 3))


def count_faults(faults: Iterable[Judgement]) -> FaultCounts:
    """Count faults by outcome. Only faults that must be detected are counted."""
    judged = [fault for fault in faults if fault.is_judged]
    struck = [fault for fault in judged if fault.seen != "not struck"]
    return FaultCounts(
        drawn=len(judged),
        injected=len(struck),
        detected=sum(fault.seen == "detected" for fault in struck),
        missed=sum(fault.seen == "missed" for fault in struck),
        not_struck=len(judged) - len(struck),
        within_bound=sum(fault.is_within for fault in struck),
        reacted_to=sum(not fault.lacking for fault in struck),
        recovered=sum(fault.is_recovered for fault in struck),
        latched=sum(fault.is_latched for fault in struck),
    )


def list_size_points(faults: Iterable[Judgement], kind: str, clock_ns: int) -> list[SizePoint]:
    """Return the points of a kind's curve of size against delay, sorted by size.

    Args:
        faults: Judged faults of any kind.
        kind: Name of the kind.
        clock_ns: Length of a tick in ns.
    """
    struck = [fault for fault in faults if fault.kind == kind and fault.struck >= 0]
    points = [
        SizePoint(fault.size or 0.0, fault.joint, _to_ms(fault.delay, clock_ns), fault.delay)
        for fault in struck
    ]
    return sorted(points, key=lambda point: point.size)


def compute_spread(values: Iterable[float | None]) -> Spread | None:
    """Return median and maximum of the values, ignoring None. None if no value remains."""
    numbers = [value for value in values if value is not None]
    return Spread(round(median(numbers), 3), round(max(numbers), 3)) if numbers else None


def _compute_figures(kind: str, faults: Sequence[Judgement], clock_ns: int) -> KindFigures:
    """Compute the figures of one kind."""
    detected = [fault for fault in faults if fault.seen == "detected"]
    counts = vars(count_faults(faults))
    shares = ("detected", "within_bound", "recovered")
    bounds = [fault.bound for fault in faults if fault.bound is not None]
    bound_ticks = {"least": min(bounds), "most": max(bounds)} if bounds else None
    return KindFigures(
        **counts,
        wilson={
            share: compute_wilson_interval(counts[share], counts["injected"]) for share in shares
        },
        bound=str(find_record(kind).bound),
        cycles=compute_spread(
            fault.delay / fault.cycle for fault in detected if fault.delay is not None
        ),
        ticks=compute_spread(fault.delay for fault in detected),
        bound_ticks=bound_ticks,
        part_of_bound=compute_spread(fault.fraction_of_bound for fault in detected),
        ms=compute_spread(fault.delay_ms for fault in detected),
        reactions=sorted({name for fault in faults for name in fault.reactions}),
        recovery_ms=compute_spread(_to_ms(fault.recovery, clock_ns) for fault in detected),
    )


def _to_ms(ticks: int | None, clock_ns: int) -> float | None:
    """Convert ticks to ms. None remains None."""
    return None if ticks is None else round(ticks * clock_ns * 1e-6, 3)
