"""Lanes: spans of states over time. rerun marks this archetype as unstable, so it is used here alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import rerun as rr
import rerun.blueprint as rrb

from rack.tools.viewer.palette import Colour
from rack.tools.viewer.stream import Stream


def style_lane(stream: Stream, entity: Sequence[str], colours: Mapping[str, Colour], quiet: Sequence[str] = ()) -> None:
    """Give the states of a lane their colours, and all but the `quiet` ones their names.

    A state that is not named here takes what the viewer picks.
    """
    names = list(colours)
    labels = [" " if name in quiet else name for name in names]
    stream.static(entity, rr.StateConfiguration(values=names, labels=labels, colors=list(colours.values())))


def write_spans(stream: Stream, entity: Sequence[str], times: list[rr.TimeColumn], states: Sequence[str]) -> None:
    """Write the states that begin at `times`; each lasts until the next, and "" is none."""
    stream.columns(entity, times, rr.StateChange.columns(state=states))


def write_span(stream: Stream, tick: int, stamp_ns: int, entity: Sequence[str], state: str) -> None:
    """Write one state that begins now."""
    stream.at(tick, stamp_ns, entity, rr.StateChange(state=state))


def lanes_view(name: str, contents: Sequence[str], around_s: float | None = None) -> rrb.View:
    """Return a view of lanes: all of the run, or what lies within `around_s` of the time that is looked at."""
    axis = rrb.TimeAxis(link="LinkToGlobal")
    if around_s is not None:
        begin, end = (rrb.TimeRangeBoundary.cursor_relative(seconds=at) for at in (-around_s, around_s))
        axis = rrb.TimeAxis(link="Independent", view_range=rrb.TimeRange(start=begin, end=end))
    return rrb.StateTimelineView(origin="/", contents=list(contents), name=name, time_view=axis)
