"""What the numbers of a level mean, in one line."""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil

import numpy as np

from rack.levels.timing.equations import plan_cycles_tight
from rack.levels.timing.rack import LevelTiming
from rack.tools.analysis.analysis import Analysis

MS = 1e-6
UNITS = {"R": "read", "X": "execution", "W": "write", "C": "exchange", "P": "plan", "U": "update"}
"""Unit functions, and what their times are called in `LevelTiming`."""


def summary(analysis: Analysis, board: str) -> str:
    """Return what a level took of its cycle, where its planner fits, and what of it was more than its budget."""
    timing = analysis.measured.get(board)
    if timing is None:
        return "never ran"
    return "; ".join(_parts(analysis, timing))


def worst_words(percentile: float) -> str:
    """Return what a percentile means for cycles: "in the worst cycle", or "in 99 of 100 cycles"."""
    return "in the worst cycle" if percentile >= 100 else f"in {percentile:g} of 100 cycles"


def _parts(analysis: Analysis, timing: LevelTiming) -> Iterator[str]:
    used_ns = timing.execution_ns + timing.communication_ns
    usual_ns = float(np.median(analysis.cycles[timing.board].used_ns))
    when = worst_words(analysis.percentile)
    yield f"{_ms(used_ns)} of {_ms(timing.cycle_ns)} ms used {when}, {_ms(usual_ns)} usually"
    if timing.planning_ns is not None:
        yield _planner(timing, analysis.model.switch_ns)
    elif timing.coupling != "none":
        yield "its planner made no plan"
    budget = analysis.predicted.get(timing.board)
    if over := [] if budget is None else list(_over(timing, budget)):
        yield f"over its budget: {', '.join(over)}"


def _planner(timing: LevelTiming, switch_ns: float) -> str:
    planning_ns, permitted = timing.planning_ns or 0, timing.within_cycles
    if timing.coupling == "loose":
        needed: int | None = max(1, ceil(planning_ns / timing.cycle_ns))
        place = "on its own processor"
    else:
        needed = plan_cycles_tight(planning_ns, timing.residual_ns, switch_ns)
        place = "on the same processor"
    took = f"a plan takes {_ms(planning_ns)} ms {place}"
    if needed is None:
        return f"{took}, and nothing is left for it in such a cycle"
    fits = needed <= (permitted or 0)
    return f"{took}: {f'fits into {needed} of its' if fits else f'needs {needed} and has'} {permitted} cycles"


def _over(timing: LevelTiming, budget: LevelTiming) -> Iterator[str]:
    for unit, name in UNITS.items():
        took, permitted = (getattr(side, f"{name}_ns") or 0 for side in (timing, budget))
        if took > permitted:
            yield f"{unit} {_ms(took)} of {_ms(permitted)} ms"


def _ms(ns: float) -> str:
    ms = ns * MS
    return f"{ms:.0f}" if ms >= 100 else f"{ms:.3g}"
