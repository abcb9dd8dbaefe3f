"""A forecast as text, with times in ms.

It shows the response of the system, and tables of levels, verdicts and response times.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import pairwise
from math import isinf
from typing import Any

from rack.boards.timing.chains import format_names
from rack.boards.timing.forecast import Forecast
from rack.boards.timing.level import LevelTiming
from rack.boards.timing.response_time import TaskResponse
from rack.boards.timing.verdicts import BEYOND, PLAN_WITHIN, EquationVerdict
from rack.tools.console.tables import Blocks, TextTable, format_ms

TABULATED = {*BEYOND} - {PLAN_WITHIN}
"""Criteria that have separate tables."""
RESULTS = {True: "ok", False: "FAILS"}
LEVEL_COLUMNS = {
    "R_i": "cycle_ns",
    "t_exec": "execution_ns",
    "t_comm": "communication_ns",
    "R": "read_ns",
    "W": "write_ns",
    "C": "exchange_ns",
    "t_residual": "residual_ns",
    "t_plan": "planning_ns",
    "P": "plan_ns",
}
"""Times of a level in a table, and their names."""
Row = dict[str, Any]


def format_forecast(forecast: Forecast) -> Blocks:
    """Yield a forecast as text for the terminal."""
    rack = forecast.rack
    system = forecast.system
    if system.levels:
        yield ""
        yield (
            f"system response, {' > '.join(system.levels)}: eq. 3.3 sum of the cycles"
            f" {system.sum_eq_3_3_ms:g} ms, eq. 3.2 bound {system.bound_eq_3_2_ms:g} ms"
        )
    for level, plan_ms in system.plan_ms.items():
        yield f"plan of {level}: available {plan_ms:g} ms after its planner's release"
    if rack.levels:
        yield from (
            "",
            f"worst case by the budgets, ms; t_cs is {format_ms(rack.context_switch_ns)} ms:",
            "",
        )
        yield build_level_table(
            ((level.coupling, level) for level in rack.levels.values()), "coupling"
        )
    if paper := [verdict for verdict in forecast.verdicts if verdict.equation not in TABULATED]:
        yield ""
        yield build_verdict_table(("", verdict) for verdict in paper)
    if rack.responses:
        yield from ("", "response times of the tasks that share a core, by priority, ms:", "")
        yield _build_table(_list_responses(rack.responses), ("priority", "margin"))
    if forecast.inboxes:
        yield from ("", "interrupts, served by the first task of the board, ms:", "")
        inboxes = (
            inbox
            | {
                "mailboxes": format_names([box.partition(".")[0] for box in inbox["mailboxes"]]),
                "fits": RESULTS[inbox["fits"]],
            }
            for inbox in forecast.inboxes
        )
        yield _build_table(inboxes, ("mailboxes",))
    yield from _format_schedule(forecast)


def _format_schedule(forecast: Forecast) -> Blocks:
    """Yield a table of a static schedule, with a row for each board in each distinct frame."""
    if forecast.rack.schedule is None:
        return
    minor, major = forecast.rack.schedule
    count = major // minor
    ticks = "a tick" if minor == 1 else f"{minor} ticks"
    sizes = f"{count} frames of {format_ms(minor * forecast.rack.tick_ns)}, {ticks}"
    yield ""
    yield f"static schedule, ms: {sizes}; every budget with two context switches:"
    yield ""
    rows: list[Row] = [
        {
            "core": alike.core,
            "frames": _format_frame_numbers(alike.frames, count),
            "board": place.board,
            "offset": format_ms(place.offset_ns),
            "budget": format_ms(place.job_ns),
            "slack": format_ms(place.slack_ns),
            "until": place.until or "end of frame",
            "": RESULTS[place.slack_ns >= 0],
        }
        for alike in forecast.frames
        for place in alike.places
    ]
    yield TextTable(rows, ("until",))


def _format_frame_numbers(frames: Sequence[int], count: int) -> str:
    """Format the numbers of frames. Equidistant ones are shortened to the first two and the last.

    Args:
        frames: Numbers in ascending order.
        count: Number of all frames.
    """
    if len(frames) == count:
        return "all"
    if len(frames) <= 3:
        return ", ".join(map(str, frames))
    first, second, third, *_, last = frames
    if len({later - earlier for earlier, later in pairwise(frames)}) == 1:
        return f"{first}, {second} ... {last}"
    return f"{first}, {second}, {third} ... {last}: {len(frames)}"


def build_level_table(levels: Iterable[tuple[str, LevelTiming]], about: str) -> TextTable:
    """Build a table with the cycle of each level, the parts of the cycle and the residual, in ms.

    Args:
        levels: Levels, each with its word in the column after the names.
        about: Heading of this column.
    """
    rows: Iterable[Row] = (
        {
            "level": level.board,
            about: word,
            **{head: format_ms(getattr(level, name)) for head, name in LEVEL_COLUMNS.items()},
            "U": format_ms(None if level.plan_ns is None else level.update_ns),
            "d": level.within_cycles,
            "d R_i": format_ms(level.slice_ns),
        }
        for word, level in levels
    )
    return TextTable(merge_rows(rows, "level"), ("C", "R", "W", "U", "P", "d"))


def build_verdict_table(verdicts: Iterable[tuple[str, EquationVerdict]]) -> TextTable:
    """Build a table with a row per verdict.

    It gives the left and right side of the equation, the margin, and whether the equation holds.

    Args:
        verdicts: Verdicts, each with its origin, "predicted" or "measured". If all origins are
            empty, the table has no column for them.
    """
    rows: Iterable[Row] = (
        {
            "eq.": verdict.equation,
            "of": verdict.subject,
            **({"side": side} if side else {}),
            "left": format_side(verdict.left, verdict.unit),
            " ": verdict.sign,
            "right": format_side(verdict.right, verdict.unit),
            "margin": format_side(verdict.margin, verdict.unit),
            "": RESULTS[verdict.holds],
            "meaning": verdict.meaning,
        }
        for side, verdict in verdicts
    )
    return TextTable(merge_rows(rows, "of"), ("meaning", "margin"))


def format_side(value: float, unit: str) -> str:
    """Format one side of an equation: a time in ms, or a number with three significant digits."""
    if isinf(value):
        return "endless" if value > 0 else "-"
    return format_ms(value) if unit == "ns" else f"{value:.3g}"


def _list_responses(responses: Iterable[TaskResponse]) -> Iterator[Row]:
    """Yield the worst-case responses of tasks, by core, then by descending priority."""
    for response in sorted(responses, key=lambda task: (task.core, -task.priority)):
        worst_ns, deadline_ns = response.response_ns, response.deadline_ns
        margin_ns = None if worst_ns is None else deadline_ns - worst_ns
        yield asdict(response) | {"margin_ns": margin_ns, "": RESULTS[response.holds]}


def _build_table(records: Iterable[Row], dropped: Sequence[str]) -> TextTable:
    """Build a table of tasks. The keys of the records become its columns, and ns become ms.

    Args:
        records: A record for each row, with the task under the key "task".
        dropped: Columns that a narrow terminal leaves out, in that order.
    """
    rows = (
        {
            key.removesuffix("_ns").replace("_", " "): (
                format_ms(value) if key.endswith("_ns") else value
            )
            for key, value in record.items()
        }
        for record in records
    )
    return TextTable(merge_rows(rows, "task"), dropped)


def merge_rows(rows: Iterable[Mapping[str, Any]], name: str) -> list[dict[str, Any]]:
    """Merge rows that differ only in the column `name`.

    Otherwise a rack with a board per joint would fill a page.
    """
    names: dict[tuple[tuple[str, Any], ...], list[str]] = {}
    for row in rows:
        names.setdefault(tuple({**row, name: ""}.items()), []).append(str(row[name]))
    return [{**dict(common), name: format_names(merged)} for common, merged in names.items()]
