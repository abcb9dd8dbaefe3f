"""The times of one task from its trace, in the terms of eq. 3.5: R = t_exec + t_comm + t_residual."""

from __future__ import annotations

from typing import Any

import numpy as np

from backplane.layout import TaskSpec
from tools.reporting.statistics import distribution


def task_times(task: TaskSpec, cycles: np.ndarray, period_ns: int) -> dict[str, Any]:
    """Return the times of a task's traced cycles, ms of the wall clock.

    `period_ns` is one tick of the wall clock. A planner's cycles are its plans, and its R their time slice.
    """
    slice_ns = task.every * task.within_cycles * period_ns
    execution = (cycles["process_ns"] - cycles["read_ns"]) * 1e-6
    communication = (cycles["read_ns"] - cycles["start_ns"] + cycles["end_ns"] - cycles["process_ns"]) * 1e-6
    lateness = (cycles["start_ns"] - cycles["release_ns"]) * 1e-6
    residual = (cycles["release_ns"] + slice_ns - cycles["end_ns"]) * 1e-6
    gaps = np.diff(cycles["start_ns"]) * 1e-6
    return {
        "traced": len(cycles),
        "slice_ms": slice_ns * 1e-6,
        "lateness_ms": distribution(lateness),
        "execution_ms": distribution(execution),
        "communication_ms": distribution(communication),
        "residual_ms": distribution(residual),
        "largest_gap_ms": round(float(gaps.max()), 6) if len(gaps) else None,
        "alpha_ms": _alpha_ms(slice_ns, execution, communication),
    }


def _alpha_ms(slice_ns: int, execution: np.ndarray, communication: np.ndarray) -> float | None:
    """Return alpha of eq. 3.6: the part of R that is left in the worst cycle."""
    if not len(execution):
        return None
    return round(slice_ns * 1e-6 - float(execution.max()) - float(communication.max()), 6)


def plan_age_ms(executor: np.ndarray, plan_tick: np.ndarray, plan_visible_at: np.ndarray, tick_ms: float) -> Any:
    """Return how old, in simulated time, the plan was that each cycle of an executor could read.

    `executor` holds the ticks of its cycles; `plan_tick` and `plan_visible_at` are of the plans, in order.
    """
    # A late plan does not hide behind an earlier tick of a later one.
    newest = np.searchsorted(np.maximum.accumulate(plan_visible_at), executor, side="right") - 1
    seen = newest >= 0
    return distribution((executor[seen] - plan_tick[newest[seen]]) * tick_ms)
