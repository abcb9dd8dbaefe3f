"""Verdicts and the times that they rest on, as tables for people; times in ms.

To fit into a `width` they do without some columns.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from rack.tools.console.tables import table
from rack.tools.timing.level_timing import LevelTiming
from rack.tools.timing.task_response import TaskResponse
from rack.tools.timing.verdict import Verdict


def level_table(levels: Iterable[LevelTiming], width: int | None = None) -> Iterator[str]:
    """Yield a line a level: its cycle, what fills it, and what is left of it for its planner."""
    head = [
        "level",
        "coupling",
        "R_i",
        "t_exec",
        "t_comm",
        "R",
        "W",
        "C",
        "t_residual",
        "t_plan",
        "P",
        "U",
        "d",
        "d R_i",
    ]
    yield from table(head, [_level_row(level) for level in levels], width, ("C", "R", "W", "U", "P", "d"))


def verdict_table(verdicts: Iterable[Verdict], width: int | None = None) -> Iterator[str]:
    """Yield a line a verdict: both sides, the margin, whether it holds."""
    head = ["eq.", "of", "left", "", "right", "margin", "", "which is"]
    yield from table(head, [_verdict_row(verdict) for verdict in verdicts], width, ("which is", "margin"))


def response_table(responses: Iterable[TaskResponse], width: int | None = None) -> Iterator[str]:
    """Yield a line a task: what it computes, what keeps it waiting, and its deadline; a core after the other."""
    head = ["core", "task", "FIFO", "computes", "blocked", "response", "deadline", "margin", ""]
    ordered = sorted(responses, key=lambda response: (response.core, -response.priority))
    yield from table(head, [_response_row(response) for response in ordered], width, ("FIFO", "margin"))


def ms(time_ns: float | None) -> str:
    """Return a time in ms as text, to the us; "-" for none."""
    return "-" if time_ns is None else f"{round(time_ns * 1e-6, 3):g}"


def _level_row(level: LevelTiming) -> list[str]:
    own = (level.cycle_ns, level.execution_ns, level.communication_ns, level.read_ns, level.write_ns, level.exchange_ns)
    plan = (level.planning_ns, level.plan_ns, level.update_ns if level.plan_ns is not None else None)
    cycles = "-" if level.within_cycles is None else str(level.within_cycles)
    times = [ms(time) for time in (*own, level.residual_ns, *plan)]
    return [level.board, level.coupling, *times, cycles, ms(level.slice_ns)]


def _verdict_row(verdict: Verdict) -> list[str]:
    sides = verdict.left, verdict.right, verdict.margin
    left, right, margin = (ms(side) if verdict.unit == "ns" else f"{side:.3g}" for side in sides)
    return [verdict.equation, verdict.subject, left, verdict.sign, right, margin, _said(verdict.holds), verdict.meaning]


def _response_row(response: TaskResponse) -> list[str]:
    found = response.response_ns
    margin = None if found is None else response.deadline_ns - found
    times = (response.job_ns, response.blocking_ns, found, response.deadline_ns, margin)
    priority = str(response.priority or "-")
    return [str(response.core), response.task, priority, *(ms(time) for time in times), _said(response.holds)]


def _said(holds: bool) -> str:
    return "ok" if holds else "FAILS"
