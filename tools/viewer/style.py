"""Colours, one meaning each, and lanes: spans of coloured states over time.

rerun marks the archetype of lanes as unstable, so it is used only here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import rerun as rr
import rerun.blueprint as rrb

from rack.tools.viewer.stream import Moment, Stream

Colour = tuple[int, int, int, int]
"""Red, green, blue, alpha, 0 to 255."""

_JOINTS: tuple[Colour, ...] = (
    (86, 180, 233, 255),
    (230, 159, 0, 255),
    (0, 190, 140, 255),
    (240, 228, 66, 255),
    (204, 121, 167, 255),
    (213, 94, 0, 255),
    (150, 140, 255, 255),
)
"""Distinguishable without red or green vision (Okabe and Ito)."""
COMMANDED: Colour = (130, 130, 130, 160)
LIMIT: Colour = (200, 60, 60, 110)
PLANNED: Colour = (255, 200, 40, 255)
GOAL: Colour = (70, 210, 90, 255)
CURRENT: Colour = (255, 110, 40, 255)
FORCE: Colour = (240, 60, 60, 255)
LOST: Colour = (230, 50, 50, 255)

_GREY: Colour = (110, 110, 120, 255)
_BLUE: Colour = (70, 140, 230, 255)
_GREEN: Colour = (70, 180, 90, 255)
_YELLOW: Colour = (230, 180, 60, 255)
_ORANGE: Colour = (240, 140, 30, 255)
_RED: Colour = (220, 50, 50, 255)
STATES: dict[str, Colour] = {
    "idle": _GREY,
    "executing": _BLUE,
    "done": _GREEN,
    "holding": _YELLOW,
    "error": _RED,
    "missed": _ORANGE,
    "lost": (120, 20, 20, 255),
}
EVENT_COLOURS: dict[str, Colour] = {
    "launch": _GREY,
    "ready": _GREY,
    "start": _BLUE,
    "stop": _ORANGE,
    "end": _GREEN,
    "died": _RED,
    "fault": (190, 90, 210, 255),
    "detection": _ORANGE,
    "reaction": (220, 90, 60, 255),
    "recovery": _GREEN,
}
"""By kind; the viewer picks a colour for any other."""
PHASES: dict[str, Colour] = {
    "wait": (60, 62, 70, 255),
    "read": (90, 170, 220, 255),
    "process": _GREEN,
    "plan": (150, 110, 220, 255),
    "write": _YELLOW,
    "missed": (230, 50, 50, 255),
}


def of_joint(at: int) -> Colour:
    """Return the colour of a joint by its index, from base to tool."""
    return _JOINTS[at % len(_JOINTS)]


def dimmed(colour: Colour) -> Colour:
    """Return a colour of which less is seen."""
    return (*colour[:3], 110)


def style_lane(
    stream: Stream, entity: Sequence[str], colours: Mapping[str, Colour], quiet: Sequence[str] = ()
) -> None:
    """Set the colours of a lane's states, and their labels except for the `quiet` ones.

    The viewer picks a colour for any other state.
    """
    names = list(colours)
    labels = [" " if name in quiet else name for name in names]
    stream.static(
        entity, rr.StateConfiguration(values=names, labels=labels, colors=list(colours.values()))
    )


def style_curves(
    stream: Stream,
    entity: Sequence[str],
    names: Sequence[str],
    colours: Sequence[Colour] | None = None,
    widths: Sequence[float] | None = None,
) -> None:
    """Set names, colours and widths of an entity's curves; without colours the viewer picks
    them."""
    stream.static(entity, rr.SeriesLines(names=names, colors=colours, widths=widths))


def write_spans(
    stream: Stream, entity: Sequence[str], times: list[rr.TimeColumn], states: Sequence[str]
) -> None:
    """Write the states that begin at `times`; each lasts until the next, and "" is none."""
    stream.columns(entity, times, rr.StateChange.columns(state=states))


def write_span(stream: Stream, when: Moment, entity: Sequence[str], state: str) -> None:
    """Write one state that begins then."""
    stream.at(when, entity, rr.StateChange(state=state))


def lanes_view(name: str, contents: Sequence[str], around_s: float | None = None) -> rrb.View:
    """Return a view of lanes: of the whole run, or of `around_s` before and after the time
    cursor."""
    axis = rrb.TimeAxis(link="LinkToGlobal")
    if around_s is not None:
        begin, end = (
            rrb.TimeRangeBoundary.cursor_relative(seconds=at) for at in (-around_s, around_s)
        )
        axis = rrb.TimeAxis(link="Independent", view_range=rrb.TimeRange(start=begin, end=end))
    return rrb.StateTimelineView(origin="/", contents=list(contents), name=name, time_view=axis)
