"""The paper's timing model, equations 3.1 to 3.10, as plain functions (NISTIR 90-4251, section 3).

All times are in ns. A level's cycle is its response time R; communicating includes waiting. "Executor-planner" is
what the executor spends on taking over a plan.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import floor
from statistics import pstdev

SMALL_SHARE = 0.1
"""Part of a cycle that counts as much smaller than the cycle (eq. 3.10)."""


def fits_cycle(processing_ns: float, communication_ns: float, longest_cycle_ns: float) -> bool:
    """Say whether a level's processing and communicating fit the longest cycle permitted (eq. 3.1)."""
    return processing_ns + communication_ns <= longest_cycle_ns


def system_response_bound_ns(cycles_ns: Sequence[float]) -> float:
    """Return the bound on the system's response time: as many longest cycles as there are levels (eq. 3.2)."""
    return len(cycles_ns) * max(cycles_ns)


def system_response_ns(machine_cycles_ns: Sequence[float], goal_cycles_ns: Sequence[float]) -> float:
    """Return the system's response time (eq. 3.3).

    `machine_cycles_ns` are tied to the update rate of the machine, `goal_cycles_ns` chosen to meet the goal.
    """
    return sum(machine_cycles_ns) + sum(goal_cycles_ns)


def executes_in_time(execution_ns: float, longest_cycle_ns: float) -> bool:
    """Say whether an executor leaves anything of the longest cycle permitted (eq. 3.4)."""
    return execution_ns < longest_cycle_ns


def response_time_ns(execution_ns: float, communication_ns: float, residual_ns: float) -> float:
    """Return a level's response time from its parts (eq. 3.5)."""
    return execution_ns + communication_ns + residual_ns


def residual_bound_ns(cycle_ns: float, executions_ns: Sequence[float], communications_ns: Sequence[float]) -> float:
    """Return alpha, the residual that is sure to be left in the worst cycle (eq. 3.6); negative when there is none.

    The longest execution and the longest communication count, whether or not they fell into one cycle.
    """
    return cycle_ns - max(executions_ns) - max(communications_ns)


def residual_is_sure(residual_ns: float, bound_ns: float) -> bool:
    """Say whether background work of `residual_ns` a cycle can be counted on (eq. 3.6)."""
    return 0 < residual_ns <= bound_ns


def residual_deviation_ns(executions_ns: Sequence[float], communications_ns: Sequence[float]) -> float:
    """Return the standard deviation of the residual from cycle to cycle: smooth motion needs a small one (eq. 3.6)."""
    return pstdev([e + c for e, c in zip(executions_ns, communications_ns, strict=True)])


def cycle_start_ns(first_ns: int, period_ns: int, cycle: int) -> int:
    """Return the start of a cycle on the fixed grid of the system clock (eq. 3.7)."""
    return first_ns + cycle * period_ns


def plan_fits_tight(plan_ns: float, cycles: int, residual_ns: float, context_switch_ns: float) -> bool:
    """Say whether a planner on its executor's processor finishes within `cycles` of what is left (eq. 3.8).

    `plan_ns` includes the update of the plan.
    """
    return plan_ns / cycles < residual_ns - 2 * context_switch_ns


def plan_cycles_tight(plan_ns: float, residual_ns: float, context_switch_ns: float) -> int | None:
    """Return the fewest cycles within which such a planner finishes (eq. 3.8); None: never."""
    left_ns = residual_ns - 2 * context_switch_ns
    return floor(plan_ns / left_ns) + 1 if left_ns > 0 else None


def plan_fits_loose(plan_ns: float, cycles: int, cycle_ns: float) -> bool:
    """Say whether a planner on a processor of its own finishes within `cycles` (section 3.4, fig. 4)."""
    return plan_ns <= cycles * cycle_ns


def communication_ns(interlevel_ns: float, executor_planner_ns: float) -> float:
    """Return the time that a tightly coupled executor communicates in a cycle (eq. 3.9)."""
    return interlevel_ns + executor_planner_ns


def response_time_tight_ns(
    execution_ns: float, communication_ns: float, plan_and_residual_ns: float, context_switch_ns: float
) -> float:
    """Return the response time of a level whose planner shares its executor's processor (eq. 3.9)."""
    return execution_ns + communication_ns + plan_and_residual_ns + 2 * context_switch_ns


def plan_update_share(executor_planner_ns: float, cycle_ns: float) -> float:
    """Return the part of a cycle that updating the plan takes (eq. 3.10)."""
    return executor_planner_ns / cycle_ns


def coupling_may_be_tight(executor_planner_ns: float, cycle_ns: float, small: float = SMALL_SHARE) -> bool:
    """Say whether updating the plan is a small part of the cycle; else split planner and executor (eq. 3.10)."""
    return plan_update_share(executor_planner_ns, cycle_ns) <= small
