"""Every equation of the timing model, put to every level, core and task of a rack.

Equations 3.1 to 3.10 are judged as the paper has them, each level as if it had a processor to itself. What levels do
to each other that share a core, the response times tell, and the load of the core.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from math import inf

from rack.backplane.layout import Layout
from rack.boards.config.schema import RackConfig
from rack.boards.config.timing import NS_PER_MS, tick_ns, timed_tasks
from rack.levels.timing import equations
from rack.levels.timing.budget import Budget
from rack.levels.timing.relation import Relation
from rack.levels.timing.response_time import load_of, response_times
from rack.levels.timing.tasks import TimedTask
from rack.tools.timing.level_timing import LevelTiming, level_timings
from rack.tools.timing.prediction import chains, longest_cycles, response_ticks
from rack.tools.timing.verdict import Verdict

SYSTEM = "system"
"""The subject of what the levels do together."""
LOOSE_PLAN = "fig. 4"
"""A loosely coupled planner's slice: the paper has it in its text and its figure 4, without a number."""
PLAN_WITHIN, RESPONSE_TIME, LOAD = "plan within", "response time", "load"
"""What is judged beyond the paper."""
EQUATIONS = "3.1", "3.2", "3.3", "3.4", "3.5", "3.6", "3.7", "3.8", LOOSE_PLAN, "3.9", "3.10"
BEYOND = PLAN_WITHIN, RESPONSE_TIME, LOAD
"""All that a verdict may be on, in the order in which verdicts are given."""


def verdicts(config: RackConfig, layout: Layout, budgets: Mapping[str, Budget]) -> list[Verdict]:
    """Return a verdict of every equation on all that has a budget, in the order of the equations; times in ns.

    A response time without a bound is infinite.
    """
    switch_ns, small = context_switch_ns(config), config.timing.small_share
    tasks = timed_tasks(config, layout, budgets)
    levels = level_timings(config, layout, budgets)
    found = chain(
        system_verdicts(config, {task.name: task.every for task in layout.tasks}),
        *(level_verdicts(level, tick_ns(config), switch_ns, small) for level in levels),
        _of_tasks(tasks, switch_ns),
        _of_cores(tasks, switch_ns),
    )
    order = (*EQUATIONS, *BEYOND)
    return sorted(found, key=lambda verdict: order.index(verdict.equation))


def level_verdicts(level: LevelTiming, clock_ns: int, switch_ns: int, small: float) -> Iterator[Verdict]:
    """Yield the verdicts of the equations on one level by itself: `clock_ns` is c, `small` the share of eq. 3.10."""
    yield from _of_cycle(level, clock_ns)
    yield from _of_planner(level, switch_ns, small)


def system_verdicts(config: RackConfig, cycles: Mapping[str, int]) -> Iterator[Verdict]:
    """Yield the verdicts on the system's response: `cycles` are those of its boards, by name, in ticks."""
    clock_ns, ways, goal_ms = tick_ns(config), chains(config), config.timing.response_ms
    goal_ns = None if goal_ms is None else goal_ms * NS_PER_MS / config.clock.speed
    for way in ways:
        subject = SYSTEM if len(ways) == 1 else f"{SYSTEM}, {way[-1]}"
        yield from _of_chain(subject, [cycles[name] * clock_ns for name in way], clock_ns, goal_ns)
    if goal_ns is not None:
        longest = longest_cycles(config)
        for name in dict.fromkeys(chain(*ways)):
            within = Relation(cycles[name] * clock_ns, "<=", round(longest[name] * clock_ns))
            yield _judged("3.1", name, within, "R_i <= R_max = R_s / n")


def _of_chain(subject: str, cycles_ns: Sequence[int], clock_ns: int, goal_ns: float | None) -> Iterator[Verdict]:
    bound, meant = goal_ns, "timing.response_ms"
    if bound is None:
        bound, meant = equations.system_response_bound_ns(cycles_ns), "n R_max"
    total = equations.system_response_ns((), cycles_ns)
    yield _judged("3.3", subject, Relation(total, "<=", bound), f"R_s = sum of R_i <= {meant}")
    for way, order in (("command", 1), ("status", -1)):
        ticks = response_ticks([cycle // clock_ns for cycle in cycles_ns[::order]])
        relation = Relation(ticks * clock_ns, "<=", bound)
        yield _judged("3.2", subject, relation, f"R_s of a {way} with its waits for the grid <= {meant}")


def context_switch_ns(config: RackConfig) -> int:
    """Return t_cs as the config gives it, ns."""
    return round(config.timing.context_switch_ms * 1e6)


def _of_cycle(level: LevelTiming, clock_ns: int) -> Iterator[Verdict]:
    executes, communicates, cycle = level.execution_ns, level.communication_ns, level.cycle_ns
    relations = {
        "3.1": (equations.fits_cycle(executes, communicates, cycle), "t_proc + t_c <= R_i"),
        "3.4": (equations.executes_in_time(executes, level.longest_cycle_ns), "t_exec < R_max"),
        "3.5": (equations.parts_make_cycle(executes, communicates, cycle), "t_exec + t_comm + t_residual = R_i"),
        "3.6": (equations.residual_is_left(level.residual_ns), "0 < t_residual, alpha at most"),
        "3.7": (equations.cycle_is_on_grid(cycle, clock_ns), "R_i = k c, k whole"),
    }
    for equation, (relation, meaning) in relations.items():
        yield _judged(equation, level.board, relation, meaning)


def _of_planner(level: LevelTiming, switch_ns: int, small: float) -> Iterator[Verdict]:
    if level.planning_ns is None or level.within_cycles is None or level.slice_ns is None:
        return
    board, cycle = level.board, level.cycle_ns
    if level.plan_within_ns is not None:
        relation = Relation(level.slice_ns, "<=", level.plan_within_ns)
        yield _judged(PLAN_WITHIN, board, relation, "d R_i <= time within which the config wants a plan")
    if level.coupling == "loose":
        fits = equations.plan_fits_loose(level.planning_ns, level.within_cycles, cycle)
        yield _judged(LOOSE_PLAN, board, fits, "t_plan <= d R_i")
        return
    fits = equations.plan_fits_tight(level.planning_ns, level.within_cycles, level.residual_ns, switch_ns)
    yield _judged("3.8", board, fits, "t_plan / d < t_residual - 2 t_cs")
    communicates = equations.communication_ns(level.interlevel_ns, level.executor_planner_ns)
    leaves = equations.leaves_time_to_plan(level.execution_ns, communicates, switch_ns, cycle)
    yield _judged("3.9", board, leaves, "t_exec + t_comm + 2 t_cs < R_i, leaving t_(plan+residual)")
    share = equations.coupling_may_be_tight(level.executor_planner_ns, cycle, small)
    yield _judged("3.10", board, share, "t_executor-planner / R_i, small", "1")


def _of_tasks(tasks: Sequence[TimedTask], switch_ns: int) -> Iterator[Verdict]:
    periods = {task.name: task.period_ns for task in tasks}
    for name, found in response_times(tasks, switch_ns).items():
        relation = Relation(inf if found is None else found, "<=", periods[name])
        yield _judged(RESPONSE_TIME, name, relation, "worst-case response <= deadline")


def _of_cores(tasks: Sequence[TimedTask], switch_ns: int) -> Iterator[Verdict]:
    for core, load in load_of(tasks, switch_ns).items():
        yield _judged(LOAD, f"core {core}", Relation(load, "<=", 1.0), "what its tasks compute of its time", "1")


def _judged(equation: str, subject: str, relation: Relation, meaning: str, unit: str = "ns") -> Verdict:
    return Verdict(equation, subject, *relation, relation.holds, meaning, unit)
