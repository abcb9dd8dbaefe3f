"""The budgets that a run has measured: what its levels really took, by the unit functions of the paper."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rack.levels.timing.tasks import Budget
from rack.tools.analysis.cycles import Cycles, cycles_of
from rack.tools.recording import Recording

WORST = 100.0
"""The percentile that eq. 3.6 speaks of: the longest of all cycles."""


def measured_budgets(recording: Recording, percentile: float = WORST) -> dict[str, Budget]:
    """Return what the levels of a run took, by board, as processor time; a level that never ran is left out.

    They are the longest times of all cycles, as eq. 3.6 has it, whether or not they fell into one cycle; with a
    `percentile` below 100 the longest of that many in a hundred: a virtual machine that its host stalls counts
    that as processor time of whoever was running. The start-up of processes does not count
    (`rack.tools.analysis.cycles.START_UP_S`). Raises `Failure` for a recording that lacks columns of the trace.
    """
    return budgets_of(cycles_of(recording), percentile)


def budgets_of(found: Mapping[str, Cycles], percentile: float = WORST) -> dict[str, Budget]:
    """Return the budgets by board of what `cycles_of` found."""
    executors = {name: cycles for name, cycles in found.items() if cycles.task.role == "executor"}
    return {
        cycles.task.board: _budget(cycles, found.get(f"{name}.planner"), percentile)
        for name, cycles in executors.items()
    }


def _budget(executor: Cycles, planner: Cycles | None, percentile: float) -> Budget:
    def worst(cycles: Cycles, times_ns: np.ndarray) -> int:
        return worst_of(times_ns[cycles.is_judged], percentile)

    plans = {}
    if planner is not None:
        # Reading what a plan rests on is part of making it.
        plans["plan_ns"] = worst(planner, planner.read_ns + planner.process_ns)
        plans["update_ns"] = worst(planner, planner.write_ns)
    return Budget(
        read_ns=worst(executor, executor.read_ns),
        process_ns=worst(executor, executor.process_ns),
        write_ns=worst(executor, executor.write_ns),
        exchange_ns=worst(executor, executor.exchange_ns),
        **plans,
    )


def worst_of(times_ns: np.ndarray, percentile: float = WORST) -> int:
    """Return the percentile of times, shape (n,), as one that was measured; 0 of none."""
    return int(np.percentile(times_ns, percentile, method="higher")) if len(times_ns) else 0
