"""Marks of a plot: faults, detections, missed cycles, holds, lost boards and restarts."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

from rack.boards.events import Event
from rack.tools.recording.history import list_holds, list_misses
from rack.tools.recording.recording import Recording

MarkKind = Literal[
    "fault", "detection", "miss", "hold", "lost", "restart", "first difference", "trigger"
]
MAX_LEGEND_ENTRIES = 12
"""Largest number of curves or marks that a legend lists."""
MAX_TEXT = 90
"""Largest number of characters of a mark's text in a legend."""


class Mark(NamedTuple):
    """Something that happened at a simulated time.

    Attributes:
        time_s: Time at which it happened or began.
        kind: Kind of mark.
        text: Description.
        until_s: End of a hold. None for an instant, and for a hold that has not ended.
    """

    time_s: float
    kind: MarkKind
    text: str
    until_s: float | None = None

    def find_end_s(self, last_s: float) -> float:
        """Return the end of the mark. A hold that has not ended lasts until `last_s`."""
        if self.kind != "hold":
            return self.time_s
        return last_s if self.until_s is None else self.until_s


class MarkGroup(NamedTuple):
    """Marks with a common entry in the legend, earliest first."""

    kind: MarkKind
    label: str
    marks: list[Mark]


def list_event_marks(events: Iterable[Event], tick_s: float) -> list[Mark]:
    """Return the marks of events. Other events, such as the launch, are left out."""
    marks = []
    for event in events:
        kind: MarkKind
        if event.kind == "fault" and event.code == "begins":
            kind = "fault"
        elif event.kind in ("detection", "miss"):
            kind = event.kind
        elif event.kind == "died":
            kind = "lost"
        elif event.code == "rejoined":
            kind = "restart"
        else:
            continue
        # The texts about lost and restarted boards name the board.
        text = event.text if kind in ("lost", "restart") else f"{event.board}: {event.text}"
        marks.append(Mark(event.tick * tick_s, kind, text))
    return marks


def list_recorded_marks(recording: Recording) -> list[Mark]:
    """Return the marks of a recorded run."""
    tick_s = recording.layout.clock_ns * 1e-9
    events = (
        Event(**event) for event in recording.events if event["kind"] not in ("outcome", "miss")
    )
    marks = list_event_marks(events, tick_s)
    for miss in list_misses(recording):
        what = "missed its deadline" if miss["what"] == "late" else "skipped releases"
        marks.append(Mark(miss["tick"] * tick_s, "miss", f"{miss['task']} {what}"))
    marks += [
        Mark(hold["since_s"], "hold", f"{hold['level']}: {hold['why']}", hold["until_s"])
        for hold in list_holds(recording)
    ]
    return marks


def group_marks(marks: Sequence[Mark]) -> list[MarkGroup]:
    """Group equal marks. If they do not fit into a legend, group them by kind."""
    groups: defaultdict[tuple[str, ...], list[Mark]] = defaultdict(list)
    for mark in marks:
        groups[mark.kind, mark.text].append(mark)
    if len(groups) > MAX_LEGEND_ENTRIES:
        groups.clear()
        for mark in marks:
            groups[mark.kind,].append(mark)
    return [MarkGroup(group[0].kind, _format_label(group), group) for group in groups.values()]


def _format_label(marks: Sequence[Mark]) -> str:
    """Return the legend entry of a group: the first mark, and the number of further ones."""
    first = marks[0]
    until = "" if first.until_s is None else f" to {first.until_s:g}"
    more = f" (and {len(marks) - 1} more)" if len(marks) > 1 else ""
    text = first.text if len(first.text) <= MAX_TEXT else f"{first.text[: MAX_TEXT - 3]}..."
    return f"{first.kind}, {first.time_s:g}{until} s: {text}{more}"
