"""Colours of the view, curves, legends and lanes.

Each colour has one meaning. A lane shows states over time as coloured spans. rerun marks its
archetype for lanes as unstable, so only this module uses it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rack.tools.viewer.stream import Moment, RowBlock, Stream, ViewPart

Colour = int
"""A colour, 0xRRGGBBAA."""

_JOINTS = (
    0x56B4E9FF,
    0xE69F00FF,
    0x00BE8CFF,
    0xF0E442FF,
    0xCC79A7FF,
    0xD55E00FF,
    0x968CFFFF,
)
"""Colours that are distinguishable with red-green colour blindness (Okabe and Ito)."""
COMMANDED = 0x828282A0
LIMIT = 0xC83C3C6E
PLANNED = 0xFFC828FF
GOAL = 0x46D25AFF
CURRENT = 0xFF6E28FF
LOST = 0xE63232FF
GRID = 0xFFFFFF78
OVERLAID = (2.5, 1.0)
"""Widths of two curves. Where they coincide, the wider one is visible on both sides."""
LEGEND = "legend"
LEGEND_ROW = 30.0
"""Distance between the entries of a legend, in the units of a graph."""

_GREY = 0x6E6E78FF
_BLUE = 0x468CE6FF
_GREEN = 0x46B45AFF
_YELLOW = 0xE6B43CFF
_ORANGE = 0xF08C1EFF
_RED = 0xDC3232FF
STATES = {
    "idle": _GREY,
    "executing": _BLUE,
    "done": _GREEN,
    "holding": _YELLOW,
    "error": _RED,
    "missed": _ORANGE,
    "lost": LOST,
}
EVENT_COLOURS: dict[str, Colour] = {
    "launch": _GREY,
    "ready": _GREY,
    "start": _BLUE,
    "stop": _ORANGE,
    "end": _GREEN,
    "died": _RED,
    "fault": 0xBE5AD2FF,
    "detection": _ORANGE,
    "reaction": 0xDC5A3CFF,
    "recovery": _GREEN,
}
"""Colour of each kind of event. The viewer chooses the colours of other kinds."""
PHASES = {
    "wait": 0x3C3E46FF,
    "read": 0x5AAADCFF,
    "process": _GREEN,
    "plan": 0x966EDCFF,
    "write": _YELLOW,
    "missed": 0xE63232FF,
    "lost": LOST,
}
LETTERS = {"wait": " ", "read": "R", "process": "X", "plan": "P", "write": "W", "missed": "!"}
"""Labels of phases, as in the paper's figures, because words would not fit into the spans."""


def choose_joint_colours(count: int) -> list[Colour]:
    """Return the colours of `count` joints, from base to tool."""
    return [_JOINTS[index % len(_JOINTS)] for index in range(count)]


def dim_colour(colour: Colour) -> Colour:
    """Return a colour with reduced opacity."""
    return colour & ~0xFF | 110


def pack_colours(colours: Iterable[Colour]) -> np.ndarray:
    """Return colours as an array.

    rerun would take a list of three or four numbers as the components of one colour.
    """
    return np.array(list(colours), np.uint32)


def style_lane(
    stream: Stream,
    entity: Sequence[str],
    colours: Mapping[str, Colour],
    labels: Mapping[str, str] = {},
) -> None:
    """Set colours and labels for states of a lane. The viewer chooses the colours of other states.

    Args:
        stream: Stream to write to.
        entity: The lane.
        colours: Dictionary from state to colour.
        labels: Dictionary from state to label. By default, names of states are the labels.
    """
    shades = pack_colours(colours.values())
    shown = [labels.get(name, name) for name in colours]
    stream.log_static(
        entity, rr.StateConfiguration(values=list(colours), labels=shown, colors=shades)
    )


def style_curves(
    stream: Stream,
    entity: Sequence[str],
    names: Sequence[str],
    colours: Sequence[Colour] | None = None,
    widths: Sequence[float] | None = None,
) -> None:
    """Set names, colours and widths of an entity's curves.

    Args:
        stream: Stream to write to.
        entity: The entity.
        names: Names of the curves.
        colours: Their colours. By default the viewer chooses them.
        widths: Their widths. By default the viewer chooses them.
    """
    shades = None if colours is None else pack_colours(colours)
    stream.log_static(entity, rr.SeriesLines(names=names, colors=shades, widths=widths))


def build_curves(
    stream: Stream,
    entity: Sequence[str],
    values: Callable[[RowBlock], np.ndarray],
    names: Sequence[str],
    colours: Sequence[Colour] | None = None,
    widths: Sequence[float] | None = None,
) -> ViewPart:
    """Set the style of an entity's curves, and return the view part that writes their values.

    Args:
        stream: Stream to write to.
        entity: The entity.
        values: Function that returns the values of all rows of a block, shape (rows,) or
            (rows, curves).
        names: Names of the curves, with their units.
        colours: Their colours. By default the viewer chooses them.
        widths: Their widths. By default the viewer chooses them.
    """
    style_curves(stream, entity, names, colours, widths)
    return lambda block: stream.send_curves(entity, block.time_columns, values(block))


def write_legend(stream: Stream, what: str, names: Sequence[str], colours: list[Colour]) -> None:
    """Write a legend as a separate entity, because a legend within a plot would cover curves.

    Args:
        stream: Stream to write to.
        what: Name of the legend.
        names: Entries of the legend, from top to bottom.
        colours: Colours of the entries.
    """
    places = [(0.0, LEGEND_ROW * row) for row in range(len(names))]
    nodes = rr.GraphNodes(names, labels=names, positions=places, colors=pack_colours(colours))
    stream.log_static((LEGEND, what), nodes)


def write_spans(
    stream: Stream, entity: Sequence[str], times: list[rr.TimeColumn], states: Sequence[str]
) -> None:
    """Write states of a lane. Each state lasts until the next one.

    Args:
        stream: Stream to write to.
        entity: The lane.
        times: Time columns with the start times of the states.
        states: The states. "" means no state.
    """
    stream.send_columns(entity, times, rr.StateChange.columns(state=states))


def write_span(stream: Stream, when: Moment, entity: Sequence[str], state: str) -> None:
    """Write one state of a lane, which lasts until the next one.

    Args:
        stream: Stream to write to.
        when: Time at which the state begins.
        entity: The lane.
        state: The state, or "" for none.
    """
    stream.log_at(when, entity, rr.StateChange(state=state))


def build_lanes_view(name: str, contents: Sequence[str], around_s: float | None = None) -> rrb.View:
    """Return a view that shows lanes below each other.

    Args:
        name: Title of the view.
        contents: Queries for the lanes.
        around_s: Time that is shown before and after the time cursor. By default the whole run is
            shown.
    """
    axis = rrb.TimeAxis(link="LinkToGlobal")
    if around_s is not None:
        begin, end = (
            rrb.TimeRangeBoundary.cursor_relative(seconds=offset_s)
            for offset_s in (-around_s, around_s)
        )
        axis = rrb.TimeAxis(link="Independent", view_range=rrb.TimeRange(start=begin, end=end))
    return rrb.StateTimelineView(origin="/", contents=list(contents), name=name, time_view=axis)
