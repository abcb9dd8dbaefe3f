"""Colours, one meaning each, and lanes: spans of coloured states over time.

rerun marks the archetype of lanes as unstable, so it is used only here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rack.tools.viewer.stream import Moment, RowBlock, Stream, ViewPart

Colour = int
"""0xRRGGBBAA."""

_JOINTS: tuple[Colour, ...] = (
    0x56B4E9FF,
    0xE69F00FF,
    0x00BE8CFF,
    0xF0E442FF,
    0xCC79A7FF,
    0xD55E00FF,
    0x968CFFFF,
)
"""Distinguishable without red or green vision (Okabe and Ito)."""
COMMANDED: Colour = 0x828282A0
LIMIT: Colour = 0xC83C3C6E
PLANNED: Colour = 0xFFC828FF
GOAL: Colour = 0x46D25AFF
CURRENT: Colour = 0xFF6E28FF
FORCE: Colour = 0xF03C3CFF
LOST: Colour = 0xE63232FF
GRID: Colour = 0xFFFFFF78
OVERLAID = (2.5, 1.0)
"""Widths of two curves: the lower one shows on both sides where the two agree."""
LEGEND = "legend"
LEGEND_ROW = 30.0
LEGEND_LETTER = 7.0
"""Distance between names of a legend, and width of a letter, in the units of a graph."""

_GREY: Colour = 0x6E6E78FF
_BLUE: Colour = 0x468CE6FF
_GREEN: Colour = 0x46B45AFF
_YELLOW: Colour = 0xE6B43CFF
_ORANGE: Colour = 0xF08C1EFF
_RED: Colour = 0xDC3232FF
STATES: dict[str, Colour] = {
    "idle": _GREY,
    "executing": _BLUE,
    "done": _GREEN,
    "holding": _YELLOW,
    "error": _RED,
    "missed": _ORANGE,
    "lost": 0x781414FF,
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
"""By kind; the viewer picks a colour for any other."""
PHASES: dict[str, Colour] = {
    "wait": 0x3C3E46FF,
    "read": 0x5AAADCFF,
    "process": _GREEN,
    "plan": 0x966EDCFF,
    "write": _YELLOW,
    "missed": 0xE63232FF,
}
LETTERS = {"wait": " ", "read": "R", "process": "X", "plan": "P", "write": "W", "missed": "!"}
"""Labels of phases, as in the paper's figures: words would not fit into their spans."""


def of_joint(at: int) -> Colour:
    """Return the colour of a joint by its index, from base to tool."""
    return _JOINTS[at % len(_JOINTS)]


def of_joints(count: int) -> list[Colour]:
    """Return the colours of this many joints, from base to tool."""
    return [of_joint(at) for at in range(count)]


def dimmed(colour: Colour) -> Colour:
    """Return a colour of which less is seen."""
    return colour & ~0xFF | 110


def packed(colours: Iterable[Colour]) -> np.ndarray:
    """Return colours as rerun takes any number of them: three or four plain numbers are one colour
    to it.
    """
    return np.array(list(colours), np.uint32)


def style_lane(
    stream: Stream,
    entity: Sequence[str],
    colours: Mapping[str, Colour],
    labels: Mapping[str, str] | None = None,
) -> None:
    """Set the colours of a lane's states, and their labels: without `labels` their own names.

    The viewer picks a colour for any other state.
    """
    shades = packed(colours.values())
    shown = list(colours)
    if labels is not None:
        shown = [labels[name] for name in colours]
    stream.static(entity, rr.StateConfiguration(values=list(colours), labels=shown, colors=shades))


def style_curves(
    stream: Stream,
    entity: Sequence[str],
    names: Sequence[str],
    colours: Sequence[Colour] | None = None,
    widths: Sequence[float] | None = None,
) -> None:
    """Set names, colours and widths of an entity's curves; without colours the viewer picks
    them.
    """
    shades = None if colours is None else packed(colours)
    stream.static(entity, rr.SeriesLines(names=names, colors=shades, widths=widths))


def curves(
    stream: Stream,
    entity: Sequence[str],
    values: Callable[[RowBlock], np.ndarray],
    names: Sequence[str],
    colours: Sequence[Colour] | None = None,
    widths: Sequence[float] | None = None,
) -> ViewPart:
    """Style the curves of an entity, and return the part that writes them.

    Args:
        stream: Where they are written.
        entity: The entity.
        values: Returns the values of all rows of a block, (rows,) or (rows, curves).
        names: Names of the curves, with their units.
        colours: Their colours; without them the viewer picks some.
        widths: Their widths.
    """
    style_curves(stream, entity, names, colours, widths)
    return lambda block: stream.scalars(entity, block.times, values(block))


def write_legend(stream: Stream, what: str, names: Sequence[str], colours: list[Colour]) -> None:
    """Write names in their colours, one below the other: a legend within a plot covers curves."""
    places = [(0.0, LEGEND_ROW * row) for row in range(len(names))]
    nodes = rr.GraphNodes(names, labels=names, positions=places, colors=packed(colours))
    stream.static((LEGEND, what), nodes)


def legend_view(origin: str, name: str, names: Sequence[str]) -> rrb.View:
    """Return a view of a legend of these names."""
    half = LEGEND_LETTER * max(map(len, names)) / 2 + LEGEND_ROW / 2
    rows = (-LEGEND_ROW, LEGEND_ROW * len(names))
    bounds = rrb.VisualBounds2D(x_range=(-half, half), y_range=rows)
    return rrb.GraphView(origin=origin, name=name, visual_bounds=bounds)


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
    cursor.
    """
    axis = rrb.TimeAxis(link="LinkToGlobal")
    if around_s is not None:
        begin, end = (
            rrb.TimeRangeBoundary.cursor_relative(seconds=at) for at in (-around_s, around_s)
        )
        axis = rrb.TimeAxis(link="Independent", view_range=rrb.TimeRange(start=begin, end=end))
    return rrb.StateTimelineView(origin="/", contents=list(contents), name=name, time_view=axis)
