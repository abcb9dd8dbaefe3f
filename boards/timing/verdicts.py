"""Verdicts: the equations of the timing model for every level, core and task of a rack.

Equations 3.1 to 3.10 (NISTIR 90-4251, section 3) are applied as in the paper, where each level has
its own processor. Response times and core loads account for levels that share a core.

Symbols of the paper: R_i is the response time of a level, which is its cycle. R_max is the longest
cycle of all levels. t_exec is the processing of the executor in a cycle, t_comm its reading and
writing including waits, and t_residual the rest of the cycle. t_plan is one plan with its update, d
the number of cycles that a plan may take, and t_cs one context switch.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from itertools import chain
from math import inf, isfinite
from typing import Any, Literal

from rack.boards.timing.chains import ParallelChains
from rack.boards.timing.frames import compute_core_frames
from rack.boards.timing.level import LevelTiming
from rack.boards.timing.rack import RackTiming

Sign = Literal["<", "<=", "="]
_HOLDS: dict[Sign, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    "=": operator.eq,
}
SYSTEM = "system"
"""Subject of verdicts on the system response."""
LOOSE_PLAN = "fig. 4"
"""Criterion for a loosely coupled planner, which has no equation number in the paper."""
PLAN_WITHIN = "plan within"
RESPONSE_TIME = "response time"
LOAD = "load"
FRAMES = "frames"
INBOX = "inbox"
"""Criteria that are not in the paper."""
EQUATIONS = "3.1", "3.2", "3.3", "3.4", "3.5", "3.6", "3.7", "3.8", LOOSE_PLAN, "3.9", "3.10"
BEYOND = PLAN_WITHIN, RESPONSE_TIME, LOAD, FRAMES, INBOX
ORDER = (*EQUATIONS, *BEYOND)
"""All equations and criteria, in the order of the verdicts."""


@dataclass(frozen=True)
class EquationVerdict:
    """Verdict on one equation or criterion for one subject, predicted or measured.

    Attributes:
        equation: Number in the paper, as in "3.8", or one of `BEYOND`.
        subject: A board, a task, a core or "system".
        left: Value of the left side, in `unit`.
        sign: Relation that should hold between the sides.
        right: Value of the right side, in `unit`.
        meaning: Both sides in the paper's terms, as in "t_plan / d < t_residual - 2 t_cs".
        unit: "ns", or "1" for pure numbers.
        endless: Reason why the left side is infinite, as a clause. Empty if it is finite.
    """

    equation: str
    subject: str
    left: float
    sign: Sign
    right: float
    meaning: str
    unit: str = "ns"
    endless: str = ""

    @property
    def holds(self) -> bool:
        """Whether the two sides satisfy the equation."""
        return _HOLDS[self.sign](self.left, self.right)

    @property
    def margin(self) -> float:
        """Right side minus left side, in `unit`. Negative if an inequality fails."""
        return self.right - self.left

    @property
    def key(self) -> tuple[str, str, str]:
        """Key for finding the same verdict again after the rack's times have changed."""
        return self.equation, self.subject, self.meaning

    def to_document(self) -> dict[str, Any]:
        """Return the verdict as plain data for JSON. Infinite values become None."""
        sides = {"left": self.left, "right": self.right, "margin": self.margin}
        finite = {name: side if isfinite(side) else None for name, side in sides.items()}
        return {**asdict(self), "holds": self.holds, **finite}


def evaluate_rack(rack: RackTiming) -> list[EquationVerdict]:
    """Return the verdicts of all equations on a rack, in the order of the equations.

    Levels and tasks without a budget have no verdicts. A response time without a bound is infinite.
    """
    levels = (evaluate_level(rack, level) for level in rack.levels.values())
    beyond = _check_tasks(rack), _check_cores(rack), _check_frames(rack), _check_inboxes(rack)
    all_verdicts = chain(evaluate_response(rack), *levels, *beyond)
    return sorted(all_verdicts, key=lambda verdict: ORDER.index(verdict.equation))


def evaluate_level(rack: RackTiming, level: LevelTiming) -> Iterator[EquationVerdict]:
    """Yield the verdicts on one level, as if it had a processor to itself."""
    yield from _check_cycle(level, rack.tick_ns)
    yield from _check_planner(level, rack.context_switch_ns, rack.small_share)


def evaluate_response(rack: RackTiming) -> Iterator[EquationVerdict]:
    """Yield the verdicts on the system response along each group of chains.

    If the config has a goal for the response, also yield a verdict on each board's cycle.
    """
    goal_ns = None if rack.response_goal_ns is None else rack.response_goal_ns / rack.speed
    for chains in rack.chain_groups:
        yield from _check_chains(rack, chains, goal_ns)
    if goal_ns is not None:
        for name in dict.fromkeys(chain(*rack.chains)):
            cycle_ns = rack.boards[name].every * rack.tick_ns
            longest_ns = round(rack.longest_cycles[name] * rack.tick_ns)
            yield EquationVerdict("3.1", name, cycle_ns, "<=", longest_ns, "R_i <= R_max = R_s / n")


def name_response_subject(rack: RackTiming, chains: ParallelChains) -> str:
    """Return the subject of verdicts on the system response along a group of chains.

    It is "system", followed by the boards of the chains if the rack has several groups.
    """
    return SYSTEM if len(rack.chain_groups) == 1 else f"{SYSTEM}, {chains.text}"


def _check_chains(
    rack: RackTiming, chains: ParallelChains, goal_ns: float | None
) -> Iterator[EquationVerdict]:
    """Yield whether the response along a group of chains satisfies eqs 3.2 and 3.3.

    The bound is `goal_ns` or, if it is None, n R_max.
    """
    subject = name_response_subject(rack, chains)
    bound = goal_ns
    limit = "timing.response_ms"
    if bound is None:
        bound = chains.bound * rack.tick_ns
        limit = "n R_max"
    total = sum(chains.cycles) * rack.tick_ns
    yield EquationVerdict("3.3", subject, total, "<=", bound, f"R_s = sum of R_i <= {limit}")
    for direction, step in (("command", 1), ("status", -1)):
        ticks = rack.compute_longest_ticks(chains, step)
        meaning = f"R_s of a {direction} with its waits for the grid <= {limit}"
        yield EquationVerdict("3.2", subject, ticks * rack.tick_ns, "<=", bound, meaning)


def _check_cycle(level: LevelTiming, tick_ns: int) -> Iterator[EquationVerdict]:
    """Yield the verdicts of eqs 3.1 and 3.4 to 3.7 on the cycle of a level."""
    board = level.board
    cycle = level.cycle_ns
    used = level.execution_ns + level.communication_ns
    yield EquationVerdict("3.1", board, used, "<=", cycle, "t_proc + t_c <= R_i")
    longest = level.longest_cycle_ns
    yield EquationVerdict("3.4", board, level.execution_ns, "<", longest, "t_exec < R_max")
    # If the cycle is too short for its parts, t_residual counts as 0 and the left side is larger.
    meaning = "t_exec + t_comm + t_residual = R_i"
    yield EquationVerdict("3.5", board, max(used, cycle), "=", cycle, meaning)
    yield EquationVerdict("3.6", board, 0, "<", level.residual_ns, "0 < t_residual <= alpha")
    on_grid = max(round(cycle / tick_ns), 1) * tick_ns
    yield EquationVerdict("3.7", board, cycle, "=", on_grid, "R_i = k c, k whole")


def _check_planner(level: LevelTiming, switch_ns: int, small: float) -> Iterator[EquationVerdict]:
    """Yield the verdicts on a level's planner. Yields none if its planning time is unknown."""
    if level.planning_ns is None or level.within_cycles is None or level.slice_ns is None:
        return
    board = level.board
    cycle = level.cycle_ns
    within_ns = level.plan_within_ns
    if within_ns is not None:
        meaning = "d R_i <= budget.plan_within_ms"
        yield EquationVerdict(PLAN_WITHIN, board, level.slice_ns, "<=", within_ns, meaning)
    if level.coupling == "loose":
        yield EquationVerdict(
            LOOSE_PLAN, board, level.planning_ns, "<=", level.slice_ns, "t_plan <= d R_i"
        )
        return
    share = level.planning_ns / level.within_cycles
    left = level.residual_ns - 2 * switch_ns
    yield EquationVerdict("3.8", board, share, "<", left, "t_plan / d < t_residual - 2 t_cs")
    # The worst cycle also contains the update of the plan.
    used = level.execution_ns + level.communication_ns + level.update_ns + 2 * switch_ns
    meaning = "t_exec + t_comm + 2 t_cs < R_i, leaving t_(plan+residual)"
    yield EquationVerdict("3.9", board, used, "<", cycle, meaning)
    update = level.executor_planner_ns / cycle
    meaning = "t_executor-planner / R_i, small"
    yield EquationVerdict("3.10", board, update, "<=", small, meaning, "1")


def _check_tasks(rack: RackTiming) -> Iterator[EquationVerdict]:
    """Yield a verdict on the worst-case response time of each task."""
    for task in rack.responses:
        response_ns: float | None = task.response_ns
        endless = ""
        if response_ns is None:
            response_ns = inf
            load = rack.loads[task.core]
            state = "is overloaded" if load > 1 else "leaves it too little time"
            role = "planner" if task.task.endswith(".planner") else "board"
            endless = (
                f"{role} '{task.task}' never finishes: core {task.core} {state} (load {load:.3g})"
            )
        yield EquationVerdict(
            equation=RESPONSE_TIME,
            subject=task.task,
            left=response_ns,
            sign="<=",
            right=task.deadline_ns,
            meaning="worst-case response <= deadline",
            endless=endless,
        )


def _check_cores(rack: RackTiming) -> Iterator[EquationVerdict]:
    """Yield a verdict on the load of each core."""
    for core, load in rack.loads.items():
        meaning = "share of its time that its tasks compute"
        yield EquationVerdict(LOAD, f"core {core}", load, "<=", 1.0, meaning, "1")


def _check_frames(rack: RackTiming) -> Iterator[EquationVerdict]:
    """Yield a verdict on each board in each distinct frame of a static schedule."""
    for equal_frames in compute_core_frames(rack):
        for place in equal_frames.places:
            limit = f"'{place.until}' begins" if place.until else "the frame ends"
            meaning = f"done before {limit}, in frame {equal_frames.frames[0]}"
            end_ns = place.limit_ns - place.slack_ns
            yield EquationVerdict(FRAMES, place.board, end_ns, "<=", place.limit_ns, meaning)


def _check_inboxes(rack: RackTiming) -> Iterator[EquationVerdict]:
    """Yield a verdict on each inbox: whether it has room for the messages that wait."""
    for name, inbox in rack.inboxes.items():
        burst = inbox.burst
        most_waiting = inf
        endless = f"interrupts of '{name}' come faster than it serves them (load {burst.load:.3g})"
        if burst.waiting is not None:
            most_waiting = burst.waiting
            endless = ""
        meaning = "interrupts that wait after a burst of all senders <= depth"
        yield EquationVerdict(INBOX, name, most_waiting, "<=", inbox.depth, meaning, "1", endless)
