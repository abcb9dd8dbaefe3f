"""The figures of a campaign: by kind of fault, and the shortfalls that fail it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import median
from typing import Any

from boards.faults.kinds import KINDS, NUMBERS
from tools.campaign.judge import Judgement
from tools.campaign.plan import EXTERNAL

Figures = dict[str, Any]


def by_kind(faults: Sequence[Judgement], clock_ns: int) -> dict[str, Figures]:
    """Return the figures of each kind, in the order of `KINDS`; only faults that must be seen count."""
    order = [*NUMBERS, EXTERNAL]
    kinds = sorted({fault.kind for fault in faults if fault.is_judged}, key=order.index)
    return {kind: _figures(kind, [f for f in faults if f.kind == kind and f.is_judged], clock_ns) for kind in kinds}


def totals(faults: Iterable[Judgement]) -> Figures:
    """Return how many faults struck, were found, and were found in time."""
    judged = [fault for fault in faults if fault.is_judged]
    struck = [fault for fault in judged if fault.seen != "not struck"]
    return {
        "drawn": len(judged),
        "injected": len(struck),
        "detected": sum(fault.seen == "detected" for fault in struck),
        "missed": sum(fault.seen == "missed" for fault in struck),
        "not_struck": len(judged) - len(struck),
        "within_bound": sum(fault.is_within for fault in struck),
        "late_at_rack": sum((f.delay_ms or 0.0) > f.bound_ms for f in struck if f.bound_ms is not None),
        "recovered": sum(fault.is_recovered for fault in struck),
    }


def curve(faults: Iterable[Judgement], kind: str, clock_ns: int) -> list[Figures]:
    """Return size against delay of a kind that is seen by its size, smallest first; delay None: it was not seen."""
    found = sorted((f for f in faults if f.kind == kind and f.struck >= 0), key=lambda f: f.size or 0.0)
    return [{"size": f.size, "joint": f.joint, "delay_ms": _ms(f.delay, clock_ns), "delay": f.delay} for f in found]


def spread(values: Sequence[float]) -> Figures | None:
    """Return median and max; None of none."""
    return {"median": round(median(values), 3), "max": round(max(values), 3)} if values else None


def _figures(kind: str, faults: Sequence[Judgement], clock_ns: int) -> Figures:
    seen = [fault for fault in faults if fault.seen == "detected"]
    bounds = [fault.bound for fault in faults if fault.bound is not None]
    return {
        **totals(faults),
        "bound": KINDS[NUMBERS["kill" if kind == EXTERNAL else kind]].bound,
        "cycles": spread([f.delay / f.cycle for f in seen if f.delay is not None]),
        "ticks": spread([f.delay for f in seen if f.delay is not None]),
        "bound_ticks": {"least": min(bounds), "most": max(bounds)} if bounds else None,
        # How near to its bound each came: 1 is the bound.
        "part_of_bound": spread([part for f in seen if (part := _part(f)) is not None]),
        "ms": spread([f.delay_ms for f in seen if f.delay_ms is not None]),
        "reactions": sorted({name for fault in faults for name in fault.reactions}),
        "recovery_ms": spread([_ms(f.recovery, clock_ns) or 0.0 for f in seen if f.recovery is not None]),
    }


def part_of_bound(delay: int | None, bound: int | None, delay_ms: float | None, bound_ms: float | None) -> float | None:
    """Return a delay as a part of its bound, in time where that is what is bounded; None without a bound, or with 0."""
    if bound_ms is not None and delay_ms is not None:
        return delay_ms / bound_ms
    return delay / bound if bound and delay is not None else None


def _part(fault: Judgement) -> float | None:
    return part_of_bound(fault.delay, fault.bound, fault.delay_ms, fault.bound_ms)


def _ms(ticks: int | None, clock_ns: int) -> float | None:
    return None if ticks is None else round(ticks * clock_ns * 1e-6, 3)
