"""The paper's timing model, equations 3.1 to 3.10, as plain functions (NISTIR 90-4251, section 3).

All times are in ns. An equation that a level can fail gives both of its sides, a `Relation`, which is true where it
holds; one that defines a time gives that time. The paper's names: R_i is a level's response time, which is its cycle;
R_max the longest cycle of all levels; t_exec what the executor computes in a cycle; t_comm what it spends on reading
and writing, waiting included; t_residual what is left; t_plan what one plan takes, its update included; d the cycles
that a plan may take; t_cs one context switch.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import floor
from statistics import pstdev

from rack.levels.timing.relation import Relation

SMALL_SHARE = 0.1
"""Part of a cycle that counts as much smaller than the cycle (eq. 3.10)."""


def fits_cycle(processing_ns: float, communication_ns: float, cycle_ns: float) -> Relation:
    """Hold a level's processing and communicating against its cycle: t_proc + t_c <= R_i (eq. 3.1)."""
    return Relation(processing_ns + communication_ns, "<=", cycle_ns)


def system_response_bound_ns(cycles_ns: Sequence[float]) -> float:
    """Return the bound on the system's response time: as many longest cycles as levels, n R_max (eq. 3.2)."""
    return len(cycles_ns) * max(cycles_ns)


def system_responds(response_ns: float, cycles_ns: Sequence[float]) -> Relation:
    """Hold the system's response time against its bound: R_s <= n R_max (eq. 3.2)."""
    return Relation(response_ns, "<=", system_response_bound_ns(cycles_ns))


def system_response_ns(machine_cycles_ns: Sequence[float], goal_cycles_ns: Sequence[float]) -> float:
    """Return the system's response time: R_s = sum of R_i + sum of R_j (eq. 3.3).

    `machine_cycles_ns` are tied to the update rate of the machine, `goal_cycles_ns` chosen to meet the goal.
    """
    return sum(machine_cycles_ns) + sum(goal_cycles_ns)


def executes_in_time(execution_ns: float, longest_cycle_ns: float) -> Relation:
    """Hold an executor against the longest cycle that a level may have: t_exec < R_max (eq. 3.4)."""
    return Relation(execution_ns, "<", longest_cycle_ns)


def response_time_ns(execution_ns: float, communication_ns: float, residual_ns: float) -> float:
    """Return a level's response time from its parts: R_i = t_exec + t_comm + t_residual (eq. 3.5)."""
    return execution_ns + communication_ns + residual_ns


def residual_ns(cycle_ns: float, execution_ns: float, communication_ns: float) -> float:
    """Return what a cycle leaves, t_residual = R_i - t_exec - t_comm (eq. 3.5); negative: what it lacks."""
    return cycle_ns - execution_ns - communication_ns


def parts_make_cycle(execution_ns: float, communication_ns: float, cycle_ns: float) -> Relation:
    """Hold the parts of a cycle against it: t_exec + t_comm + t_residual = R_i (eq. 3.5).

    No time is left in a cycle that is too short for the first two: then the parts make more than the cycle.
    """
    left_ns = max(residual_ns(cycle_ns, execution_ns, communication_ns), 0)
    return Relation(response_time_ns(execution_ns, communication_ns, left_ns), "=", cycle_ns)


def residual_bound_ns(cycle_ns: float, executions_ns: Sequence[float], communications_ns: Sequence[float]) -> float:
    """Return alpha, the residual that is sure to be left in the worst cycle (eq. 3.6); negative when there is none.

    The longest execution and the longest communication count, whether or not they fell into one cycle.
    """
    return residual_ns(cycle_ns, max(executions_ns), max(communications_ns))


def residual_is_left(residual_ns: float) -> Relation:
    """Hold a residual against nothing: 0 < t_residual (eq. 3.6, its lower half)."""
    return Relation(0, "<", residual_ns)


def residual_is_sure(residual_ns: float, bound_ns: float) -> Relation:
    """Hold background work of a cycle against what is sure to be left: t_residual <= alpha (eq. 3.6, upper half)."""
    return Relation(residual_ns, "<=", bound_ns)


def residual_deviation_ns(executions_ns: Sequence[float], communications_ns: Sequence[float]) -> float:
    """Return the standard deviation of the residual from cycle to cycle: smooth motion needs a small one (eq. 3.6)."""
    return pstdev([e + c for e, c in zip(executions_ns, communications_ns, strict=True)])


def cycle_start_ns(first_ns: int, period_ns: int, cycle: int) -> int:
    """Return the start of a cycle on the fixed grid of the system clock: t_(k+1) = t_k + c (eq. 3.7)."""
    return first_ns + cycle * period_ns


def cycle_is_on_grid(cycle_ns: float, clock_ns: int) -> Relation:
    """Hold a cycle against the nearest whole number of clock periods: R_i = k c (what eq. 3.7 asks of a cycle)."""
    return Relation(cycle_ns, "=", cycle_start_ns(0, clock_ns, max(round(cycle_ns / clock_ns), 1)))


def plan_fits_tight(plan_ns: float, cycles: int, residual_ns: float, context_switch_ns: float) -> Relation:
    """Hold a planner on its executor's processor against what is left: t_plan / d < t_residual - 2 t_cs (eq. 3.8).

    `plan_ns` includes the update of the plan.
    """
    return Relation(plan_ns / cycles, "<", residual_ns - 2 * context_switch_ns)


def plan_cycles_tight(plan_ns: float, residual_ns: float, context_switch_ns: float) -> int | None:
    """Return the fewest cycles within which such a planner finishes (eq. 3.8); None: never."""
    left_ns = residual_ns - 2 * context_switch_ns
    return floor(plan_ns / left_ns) + 1 if left_ns > 0 else None


def plan_fits_loose(plan_ns: float, cycles: int, cycle_ns: float) -> Relation:
    """Hold a planner on a processor of its own against its slice: t_plan <= d R_i (section 3.4, fig. 4)."""
    return Relation(plan_ns, "<=", cycles * cycle_ns)


def communication_ns(interlevel_ns: float, executor_planner_ns: float) -> float:
    """Return what a level communicates in a cycle: t_comm = t_interlevel + t_executor-planner (eq. 3.9)."""
    return interlevel_ns + executor_planner_ns


def response_time_tight_ns(
    execution_ns: float, communication_ns: float, plan_and_residual_ns: float, context_switch_ns: float
) -> float:
    """Return the response time of a level whose planner shares its executor's processor (eq. 3.9).

    R_i = t_exec + t_comm + t_(plan+residual) + 2 t_cs.
    """
    return execution_ns + communication_ns + plan_and_residual_ns + 2 * context_switch_ns


def leaves_time_to_plan(
    execution_ns: float, communication_ns: float, context_switch_ns: float, cycle_ns: float
) -> Relation:
    """Hold all of a cycle but planning against it: t_exec + t_comm + 2 t_cs < R_i (eq. 3.9).

    The margin is t_(plan+residual). `communication_ns` is of the worst cycle, in which the plan is updated.
    """
    return Relation(response_time_tight_ns(execution_ns, communication_ns, 0, context_switch_ns), "<", cycle_ns)


def plan_update_share(executor_planner_ns: float, cycle_ns: float) -> float:
    """Return the part of a cycle that updating the plan takes (eq. 3.10)."""
    return executor_planner_ns / cycle_ns


def coupling_may_be_tight(executor_planner_ns: float, cycle_ns: float, small: float = SMALL_SHARE) -> Relation:
    """Hold the plan's update against a small part of the cycle: t_executor-planner << R_i (eq. 3.10).

    Both sides are parts of the cycle. Where it fails, planner and executor are to be split.
    """
    return Relation(plan_update_share(executor_planner_ns, cycle_ns), "<=", small)
