"""A forecast as text: the system's response, and tables of levels, verdicts and response times;
times in ms."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from math import isinf
from typing import Any

from rack.levels.timing.chains import spanned
from rack.levels.timing.forecast import Forecast
from rack.levels.timing.level import LevelTiming
from rack.levels.timing.response_time import TaskResponse
from rack.levels.timing.system_response import Prediction
from rack.levels.timing.verdicts import BEYOND, PLAN_WITHIN, EquationVerdict
from rack.tools.console.tables import fitted, ms

TABLED = {*BEYOND} - {PLAN_WITHIN}
"""Criteria that have a table of their own."""


def forecast_lines(forecast: Forecast) -> Iterator[str]:
    """Yield a forecast as text for people."""
    rack = forecast.rack
    yield from _prediction_lines(forecast.system)
    if rack.levels:
        yield from (
            "",
            f"worst case by the budgets, ms; t_cs is {ms(rack.context_switch_ns)} ms:",
            "",
        )
        yield from level_table(
            ((level.coupling, level) for level in rack.levels.values()), "coupling"
        )
    if paper := [verdict for verdict in forecast.verdicts if verdict.equation not in TABLED]:
        yield ""
        yield from verdict_table(("", verdict) for verdict in paper)
    if rack.responses:
        yield from ("", "response times of the tasks that share a core, by priority, ms:", "")
        yield from _responses(rack.responses)
        yield ""
        loads = (
            f"core {core} {load:.3f}{' FAILS' if load > 1 else ''}"
            for core, load in rack.loads.items()
        )
        yield f"load: {', '.join(loads)}"
    if forecast.inboxes:
        yield from ("", "interrupts, served by the first task of the board, ms:", "")
        yield from _inboxes(forecast.inboxes)
    yield from _schedule_lines(forecast)
    yield from forecast.notes


def _schedule_lines(forecast: Forecast) -> Iterator[str]:
    """Yield a line per board of every distinct frame of a static schedule."""
    if forecast.rack.schedule is None:
        return
    minor, major = forecast.rack.schedule
    count = major // minor
    ticks = "a tick" if minor == 1 else f"{minor} ticks"
    sizes = f"{count} frames of {ms(minor * forecast.rack.tick_ns)}, {ticks}"
    yield ""
    yield f"static schedule, ms: {sizes}; every budget with two context switches:"
    yield ""
    head = ["core", "frames", "board", "offset", "budget", "slack", "until", ""]
    rows = [
        [
            str(alike.core),
            _numbers(alike.frames, count),
            place.board,
            ms(place.offset_ns),
            ms(place.job_ns),
            ms(place.slack_ns),
            place.until or "end of frame",
            _result(place.slack_ns >= 0),
        ]
        for alike in forecast.frames
        for place in alike.places
    ]
    yield from fitted(head, rows, ("until",))


def _numbers(frames: Sequence[int], count: int) -> str:
    """Return the numbers of frames as text, those at equal distances by the first two and the
    last."""
    if len(frames) == count:
        return "all"
    first = frames[0]
    second = frames[min(1, len(frames) - 1)]
    last = frames[-1]
    if len(frames) <= 3:
        return ", ".join(map(str, frames))
    even = all(later - earlier == second - first for earlier, later in pairwise(frames))
    if even:
        return f"{first}, {second} ... {last}"
    return f"{first}, {second}, {frames[2]} ... {last}: {len(frames)}"


def _prediction_lines(system: Prediction) -> Iterator[str]:
    if system.levels:
        yield ""
        yield (
            f"system response, {' > '.join(system.levels)}: eq. 3.3 sum of the cycles"
            f" {system.sum_eq_3_3_ms:g} ms, eq. 3.2 bound {system.bound_eq_3_2_ms:g} ms"
        )
    for level, plan_ms in system.plan_ms.items():
        yield f"plan of {level}: available {plan_ms:g} ms after its planner's release"


def level_table(levels: Iterable[tuple[str, LevelTiming]], about: str) -> Iterator[str]:
    """Yield a line per level: its cycle, its parts, and the residual for its planner; times in ms.

    Args:
        levels: Levels, each with a word about it.
        about: Head of the column of these words.
    """
    head = ["level", about, "R_i", "t_exec", "t_comm", "R", "W", "C", "t_residual", "t_plan", "P"]
    rows = _merged([_level_row(word, level) for word, level in levels], 0)
    yield from fitted([*head, "U", "d", "d R_i"], rows, ("C", "R", "W", "U", "P", "d"))


def verdict_table(verdicts: Iterable[tuple[str, EquationVerdict]]) -> Iterator[str]:
    """Yield a line per verdict: both sides, the margin, whether it holds. Each comes with the side
    that it is of, predicted or measured; "": the table needs none."""
    head = ["eq.", "of", "side", "left", "", "right", "margin", "", "meaning"]
    rows = _merged([_verdict_row(side, verdict) for side, verdict in verdicts], 1)
    if not any(row[2] for row in rows):
        for row in (head, *rows):
            del row[2]
    yield from fitted(head, rows, ("meaning", "margin"))


def _responses(responses: Iterable[TaskResponse]) -> Iterator[str]:
    """Yield a line per task, core by core: its cost, its blocking, its response and its
    deadline."""
    head = ["core", "task", "FIFO", "computes", "blocked", "response", "deadline", "margin", ""]
    ordered = sorted(responses, key=lambda response: (response.core, -response.priority))
    rows = _merged([_response_row(response) for response in ordered], 1)
    yield from fitted(head, rows, ("FIFO", "margin"))


def _inboxes(inboxes: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a line per board that messages interrupt: what they cost it, and its worst burst."""
    head = ["board", "interrupted by", "in a cycle", "load", "longest", "wait", "of", ""]
    rows = [
        [
            inbox["task"],
            spanned([name.partition(".")[0] for name in inbox["mailboxes"]]),
            ms(inbox["cycle_cost_ns"]),
            f"{inbox['load']:.3f}",
            ms(inbox["longest_ns"]),
            "-" if inbox["waiting"] is None else str(inbox["waiting"]),
            str(inbox["depth"]),
            _result(inbox["fits"]),
        ]
        for inbox in inboxes
    ]
    yield from fitted(head, _merged(rows, 0), ("interrupted by",))


def _merged(rows: Sequence[Sequence[str]], named: int) -> list[list[str]]:
    """Return the rows, those that differ only in the name, in column `named`, as one: a board a
    joint fills no page."""
    names: dict[tuple[str, ...], list[str]] = {}
    for row in rows:
        names.setdefault((*row[:named], *row[named + 1 :]), []).append(row[named])
    return [[*rest[:named], spanned(found), *rest[named:]] for rest, found in names.items()]


def _level_row(word: str, level: LevelTiming) -> list[str]:
    own = (
        level.cycle_ns,
        level.execution_ns,
        level.communication_ns,
        level.read_ns,
        level.write_ns,
        level.exchange_ns,
    )
    update_ns = None if level.plan_ns is None else level.update_ns
    plan = (level.planning_ns, level.plan_ns, update_ns)
    cycles = "-" if level.within_cycles is None else str(level.within_cycles)
    times = [ms(time) for time in (*own, level.residual_ns, *plan)]
    return [level.board, word, *times, cycles, ms(level.slice_ns)]


def _verdict_row(side: str, verdict: EquationVerdict) -> list[str]:
    unit = verdict.unit
    return [
        verdict.equation,
        verdict.subject,
        side,
        side_text(verdict.left, unit),
        verdict.sign,
        side_text(verdict.right, unit),
        side_text(verdict.margin, unit),
        _result(verdict.holds),
        verdict.meaning,
    ]


def side_text(value: float, unit: str) -> str:
    """Return a side of an equation: a time in ms, anything else with three digits."""
    if isinf(value):
        return "endless" if value > 0 else "-"
    return ms(value) if unit == "ns" else f"{value:.3g}"


def _response_row(response: TaskResponse) -> list[str]:
    found = response.response_ns
    margin = None if found is None else response.deadline_ns - found
    times = (response.job_ns, response.blocking_ns, found, response.deadline_ns, margin)
    priority = str(response.priority or "-")
    return [
        str(response.core),
        response.task,
        priority,
        *(ms(time) for time in times),
        _result(response.holds),
    ]


def _result(holds: bool) -> str:
    return "ok" if holds else "FAILS"
