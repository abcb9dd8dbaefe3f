"""Marks of a plot: faults, detections, missed cycles, holds, lost boards and restarts."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

from rack.tools.recording.divergence import find_tick_range
from rack.tools.recording.history import list_holds, list_misses
from rack.tools.recording.recording import Recording

MAX_LEGEND_ENTRIES = 12
"""Largest number of curves and marks that a legend lists."""
MARKED_CODES = {"begins": "fault", "died": "lost", "rejoined": "restart"}
"""Kinds of marks by code of an event. Detections have many codes."""


class Mark(NamedTuple):
    """Something that happened at a simulated time.

    Attributes:
        time_s: Time at which it happened or began.
        kind: Kind of mark.
        text: Description.
        until_s: Time at which it ended. The same as `time_s` for an instant.
    """

    time_s: float
    kind: str
    text: str
    until_s: float


def list_marks(recording: Recording) -> list[Mark]:
    """Return the marks of a recorded run, earliest first."""
    tick_s = recording.layout.clock_ns * 1e-9
    instants = [
        (miss["tick"], "miss", f"{miss['task']} {miss['what']}") for miss in list_misses(recording)
    ]
    for event in recording.events:
        is_detection = event["kind"] == "detection"
        if kind := "detection" if is_detection else MARKED_CODES.get(event.get("code", "")):
            instants.append((event["tick"], kind, f"{event['board']}: {event['text']}"))
    marks = [
        Mark(time_s, kind, text, time_s)
        for tick, kind, text in instants
        for time_s in [round(tick * tick_s, 9)]
    ]
    end_s = find_tick_range(recording)[1] * tick_s
    for hold in list_holds(recording):
        until_s = end_s if hold["until_s"] is None else hold["until_s"]
        marks.append(Mark(hold["since_s"], "hold", f"{hold['level']}: {hold['why']}", until_s))
    return sorted(marks)


def group_marks(marks: Sequence[Mark]) -> dict[str, list[Mark]]:
    """Group equal marks, and return them by their entry in a legend.

    If there are too many entries, marks are grouped by kind.
    """
    groups: defaultdict[tuple[object, ...], list[Mark]] = defaultdict(list)
    is_by_text = len({mark[1:3] for mark in marks}) <= MAX_LEGEND_ENTRIES
    for mark in marks:
        groups[mark[1 : 2 + is_by_text]].append(mark)
    return {_format_entry(*group): group for group in groups.values()}


def _format_entry(first: Mark, *others: Mark) -> str:
    """Return the entry of a group: its first mark, and the number of the others."""
    until = f" to {first.until_s:g}" * (first.until_s > first.time_s)
    more = f" (and {len(others)} more)" * bool(others)
    return f"{first.kind}, {first.time_s:g}{until} s: {first.text}{more}"
