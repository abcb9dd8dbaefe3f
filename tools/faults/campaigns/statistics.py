"""The figures of a campaign: shares with their confidence, rates, delays, by kind of fault."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import exp, lgamma, log, sqrt
from statistics import median
from typing import Any

from rack.boards.faults.kind import KINDS
from rack.tools.faults.ending import EXTERNAL, record_of
from rack.tools.faults.judge import Judgement

Figures = dict[str, Any]


def by_kind(faults: Sequence[Judgement], clock_ns: int) -> dict[str, Figures]:
    """Return the figures of each kind, in the order of `KINDS`; only faults that must be found
    count."""
    order = [*KINDS.names, EXTERNAL]
    kinds = sorted({fault.kind for fault in faults if fault.is_judged}, key=order.index)
    return {
        kind: _figures(kind, [f for f in faults if f.kind == kind and f.is_judged], clock_ns)
        for kind in kinds
    }


Z95 = 1.959964
"""Standard deviations of the normal distribution between which 95 % lie."""
RULE_95 = 0.05


def wilson(count: int, of: int) -> tuple[float, float] | None:
    """Return the bounds of Wilson's 95 % interval of a share; None where `of` is 0."""
    if not of:
        return None
    share = count / of
    z2 = Z95**2
    middle = (share + z2 / (2 * of)) / (1 + z2 / of)
    half = Z95 / (1 + z2 / of) * sqrt(share * (1 - share) / of + z2 / (4 * of * of))
    return max(0.0, round(middle - half, 6)), min(1.0, round(middle + half, 6))


def rate(count: int, seconds: float) -> Figures | None:
    """Return events an hour, and the rate that they stay below with 95 % confidence; None where
    there is no time.

    The bound is the rate at which so few events have a probability of 5 % (Poisson).
    """
    if seconds <= 0.0:
        return None
    low = float(count)
    high = count + 10.0 + 5.0 * sqrt(count)
    for _ in range(60):
        middle = 0.5 * (low + high)
        chance = (
            sum(exp(k * log(middle) - middle - lgamma(k + 1)) for k in range(count + 1))
            if middle
            else 1.0
        )
        low, high = (middle, high) if chance > RULE_95 else (low, middle)
    hours = seconds / 3600.0
    return {"an_hour": round(count / hours, 3), "below": round(high / hours, 3)}


def totals(faults: Iterable[Judgement]) -> Figures:
    """Return how many faults struck, were found, were found in time, and so on."""
    judged = [fault for fault in faults if fault.is_judged]
    struck = [fault for fault in judged if fault.seen != "not struck"]
    return {
        "drawn": len(judged),
        "injected": len(struck),
        "detected": sum(fault.seen == "detected" for fault in struck),
        "missed": sum(fault.seen == "missed" for fault in struck),
        "not_struck": len(judged) - len(struck),
        "within_bound": sum(fault.is_within for fault in struck),
        "reacted_to": sum(not fault.lacking for fault in struck),
        "recovered": sum(fault.is_recovered for fault in struck),
        "latched": sum(fault.is_latched for fault in struck),
    }


def curve(faults: Iterable[Judgement], kind: str, clock_ns: int) -> list[Figures]:
    """Return size against delay of one kind, smallest size first; delay None: it was not found."""
    found = sorted(
        (f for f in faults if f.kind == kind and f.struck >= 0), key=lambda f: f.size or 0.0
    )
    return [
        {"size": f.size, "joint": f.joint, "delay_ms": _ms(f.delay, clock_ns), "delay": f.delay}
        for f in found
    ]


def spread(values: Sequence[float]) -> Figures | None:
    """Return median and max; None where there are no values."""
    return {"median": round(median(values), 3), "max": round(max(values), 3)} if values else None


def _figures(kind: str, faults: Sequence[Judgement], clock_ns: int) -> Figures:
    seen = [fault for fault in faults if fault.seen == "detected"]
    counts = totals(faults)
    parts = [
        part_of_bound(fault.delay, fault.bound, fault.delay_ms, fault.bound_ms) for fault in seen
    ]
    bounds = [fault.bound for fault in faults if fault.bound is not None]
    return {
        **counts,
        "wilson": {
            key: wilson(counts[key], counts["injected"])
            for key in ("detected", "within_bound", "recovered")
        },
        "bound": str(record_of(kind).bound),
        "cycles": spread([f.delay / f.cycle for f in seen if f.delay is not None]),
        "ticks": spread([f.delay for f in seen if f.delay is not None]),
        "bound_ticks": {"least": min(bounds), "most": max(bounds)} if bounds else None,
        # How near to its bound each came: 1 is the bound.
        "part_of_bound": spread([part for part in parts if part is not None]),
        "ms": spread([f.delay_ms for f in seen if f.delay_ms is not None]),
        "reactions": sorted({name for fault in faults for name in fault.reactions}),
        "recovery_ms": spread(
            [_ms(f.recovery, clock_ns) or 0.0 for f in seen if f.recovery is not None]
        ),
    }


def part_of_bound(
    delay: int | None, bound: int | None, delay_ms: float | None, bound_ms: float | None
) -> float | None:
    """Return a delay as a part of its bound, in time where time is bounded; None without a bound,
    or with bound 0."""
    if bound_ms is not None and delay_ms is not None:
        return delay_ms / bound_ms
    return delay / bound if bound and delay is not None else None


def _ms(ticks: int | None, clock_ns: int) -> float | None:
    return None if ticks is None else round(ticks * clock_ns * 1e-6, 3)
