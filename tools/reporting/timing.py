"""The times of one task from its trace, in the terms of eq. 3.5: R = t_exec + t_comm + t_residual."""

from __future__ import annotations

from typing import Any

import numpy as np

from rack.backplane.layout import TaskSpec
from rack.levels.timing.equations import residual_bound_ns, residual_deviation_ns
from rack.tools.reporting.statistics import Distribution, distribution


def task_times(task: TaskSpec, cycles: np.ndarray, period_ns: int, is_lockstep: bool = False) -> dict[str, Any]:
    """Return the times of a task's traced cycles, ms of the wall clock.

    `processor_ms` is what a cycle and waking up for it took of the processor: waiting and being preempted do not count.
    `period_ns` is one tick of the wall clock. A planner's cycles are its plans, and its R their time slice. In lockstep
    a tick lasts as long as its tasks take: what is held against a release or a slice of time is None.
    """
    slice_ns = task.every * task.within_cycles * period_ns
    execution = cycles["process_ns"] - cycles["read_ns"]
    communication = cycles["read_ns"] - cycles["start_ns"] + cycles["end_ns"] - cycles["process_ns"]
    gaps = np.diff(cycles["start_ns"])
    by_the_clock = {
        "lateness_ms": distribution((cycles["start_ns"] - cycles["release_ns"]) * 1e-6),
        "residual_ms": distribution((cycles["release_ns"] + slice_ns - cycles["end_ns"]) * 1e-6),
        "largest_gap_ms": round(float(gaps.max()) * 1e-6, 6) if len(gaps) else None,
        **_worst(slice_ns, execution.tolist(), communication.tolist()),
    }
    return {
        "traced": len(cycles),
        "slice_ms": slice_ns * 1e-6,
        "execution_ms": distribution(execution * 1e-6),
        "communication_ms": distribution(communication * 1e-6),
        "processor_ms": distribution(cycles["processor_ns"] * 1e-6),
        **(dict.fromkeys(by_the_clock) if is_lockstep else by_the_clock),
    }


def _worst(slice_ns: int, execution_ns: list[int], communication_ns: list[int]) -> dict[str, float | None]:
    """Return alpha of eq. 3.6, what is left in the worst cycle, and how much the residual varies; both in ms."""
    if not execution_ns:
        return {"alpha_ms": None, "deviation_ms": None}
    alpha_ns = residual_bound_ns(slice_ns, execution_ns, communication_ns)
    deviation_ns = residual_deviation_ns(execution_ns, communication_ns)
    return {"alpha_ms": round(alpha_ns * 1e-6, 6), "deviation_ms": round(deviation_ns * 1e-6, 6)}


def plan_age_ms(
    executor: np.ndarray, plan_tick: np.ndarray, plan_visible_at: np.ndarray, tick_ms: float
) -> Distribution | None:
    """Return the distribution of `plan_ages_ms`."""
    return distribution(plan_ages_ms(executor, plan_tick, plan_visible_at, tick_ms))


def plan_ages_ms(
    executor: np.ndarray, plan_tick: np.ndarray, plan_visible_at: np.ndarray, tick_ms: float
) -> np.ndarray:
    """Return how old, in simulated time, the plan was that each cycle of an executor could read.

    `executor` holds the ticks of its cycles; `plan_tick` and `plan_visible_at` are of the plans, in order.
    """
    # A late plan does not hide behind an earlier tick of a later one.
    newest = np.searchsorted(np.maximum.accumulate(plan_visible_at), executor, side="right") - 1
    seen = newest >= 0
    return np.asarray((executor[seen] - plan_tick[newest[seen]]) * tick_ms)
