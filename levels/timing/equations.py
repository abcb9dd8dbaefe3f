"""The paper's timing model, equations 3.1 to 3.10, as plain functions (NISTIR 90-4251, section 3).

All times are in ns. An equation that a level can fail returns both of its sides as a `Relation`;
one that defines a time returns that time. The paper's symbols: R_i is a level's response time,
which is its cycle; R_max the longest cycle of all levels; t_exec the executor's processing in a
cycle; t_comm its reading and writing, waiting included; t_residual the rest of the cycle; t_plan
one plan with its update; d the cycles that a plan may take; t_cs one context switch.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from math import gcd
from statistics import pstdev
from typing import Literal, NamedTuple

from rack.backplane.layout import TickGrid

SMALL_SHARE = 0.1
"""Share of a cycle that counts as much smaller than the cycle (eq. 3.10)."""

Sign = Literal["<", "<=", "="]

_HOLDS: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    "=": operator.eq,
}


class Relation(NamedTuple):
    """Two sides, in one unit, and the sign between them; true if it holds."""

    left: float
    sign: Sign
    right: float

    def __bool__(self) -> bool:
        """Return whether the numbers satisfy it: a tuple of three would always be true."""
        return _HOLDS[self.sign](self.left, self.right)


def fits_cycle(processing_ns: float, communication_ns: float, cycle_ns: float) -> Relation:
    """Compare a level's processing and communication with its cycle: t_proc + t_c <= R_i (eq.
    3.1)."""
    return Relation(processing_ns + communication_ns, "<=", cycle_ns)


def system_response_bound_ns(cycles_ns: Sequence[float]) -> float:
    """Return the bound on the system's response time, n R_max for n levels (eq. 3.2)."""
    return len(cycles_ns) * max(cycles_ns)


def grid_wait(written: TickGrid, read: TickGrid) -> int:
    """Return the longest time, ticks, from a message on the grid of its writer to the next read
    (eq. 3.7)."""
    common = gcd(written.every, read.every)
    return read.every - common + (read.phase - written.phase) % common


def executes_in_time(execution_ns: float, longest_cycle_ns: float) -> Relation:
    """Compare an executor with the longest permitted cycle: t_exec < R_max (eq. 3.4)."""
    return Relation(execution_ns, "<", longest_cycle_ns)


def residual_ns(cycle_ns: float, execution_ns: float, communication_ns: float) -> float:
    """Return the rest of a cycle, t_residual = R_i - t_exec - t_comm (eq. 3.5); negative if the
    cycle is too short."""
    return cycle_ns - execution_ns - communication_ns


def parts_make_cycle(execution_ns: float, communication_ns: float, cycle_ns: float) -> Relation:
    """Compare the parts of a cycle with the cycle: t_exec + t_comm + t_residual = R_i (eq. 3.5).

    A cycle too short for the first two has a residual of 0: its parts then exceed it.
    """
    return Relation(max(execution_ns + communication_ns, cycle_ns), "=", cycle_ns)


def residual_bound_ns(
    cycle_ns: float, executions_ns: Sequence[float], communications_ns: Sequence[float]
) -> float:
    """Return alpha, the residual guaranteed in the worst cycle (eq. 3.6); negative if there is
    none.

    The longest execution and the longest communication count, even if they fell into different
    cycles.
    """
    return residual_ns(cycle_ns, max(executions_ns), max(communications_ns))


def residual_is_left(residual_ns: float) -> Relation:
    """Require a residual: 0 < t_residual (eq. 3.6, its lower half)."""
    return Relation(0, "<", residual_ns)


def residual_deviation_ns(
    executions_ns: Sequence[float], communications_ns: Sequence[float]
) -> float:
    """Return the standard deviation of the residual from cycle to cycle: smooth motion needs a
    small one (eq. 3.6)."""
    return pstdev([e + c for e, c in zip(executions_ns, communications_ns, strict=True)])


def cycle_is_on_grid(cycle_ns: float, clock_ns: int) -> Relation:
    """Compare a cycle with the nearest whole number of clock periods: R_i = k c (required by eq.
    3.7)."""
    return Relation(cycle_ns, "=", max(round(cycle_ns / clock_ns), 1) * clock_ns)


def plan_fits_tight(
    plan_ns: float, cycles: int, residual_ns: float, context_switch_ns: float
) -> Relation:
    """Compare a planner on its executor's processor with the residual: t_plan / d < t_residual - 2
    t_cs (eq. 3.8).

    `plan_ns` includes the update of the plan.
    """
    return Relation(plan_ns / cycles, "<", residual_ns - 2 * context_switch_ns)


def plan_fits_loose(plan_ns: float, cycles: int, cycle_ns: float) -> Relation:
    """Compare a planner on its own processor with its time slice: t_plan <= d R_i (section 3.4,
    fig. 4)."""
    return Relation(plan_ns, "<=", cycles * cycle_ns)


def leaves_time_to_plan(
    execution_ns: float, communication_ns: float, context_switch_ns: float, cycle_ns: float
) -> Relation:
    """Compare a tightly coupled cycle without its planning with the whole: t_exec + t_comm + 2 t_cs
    < R_i (eq. 3.9).

    The margin is t_(plan+residual). `communication_ns` is of the worst cycle, in which the plan is
    updated.
    """
    return Relation(execution_ns + communication_ns + 2 * context_switch_ns, "<", cycle_ns)


def coupling_may_be_tight(
    executor_planner_ns: float, cycle_ns: float, small: float = SMALL_SHARE
) -> Relation:
    """Compare the plan's update with a small share of the cycle: t_executor-planner << R_i (eq.
    3.10).

    Both sides are shares of the cycle. If it fails, planner and executor should be split.
    """
    return Relation(executor_planner_ns / cycle_ns, "<=", small)
