"""Lanes: spans of states over time. rerun marks this archetype as unstable, so it is used here alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import rerun as rr
import rerun.blueprint as rrb

from tools.viewer.palette import Colour
from tools.viewer.stream import Stream


def style_lane(stream: Stream, entity: Sequence[str], colours: Mapping[str, Colour]) -> None:
    """Give the states of a lane their colours; others take what the viewer picks."""
    names = list(colours)
    stream.static(entity, rr.StateConfiguration(values=names, labels=names, colors=list(colours.values())))


def write_spans(stream: Stream, entity: Sequence[str], times: list[rr.TimeColumn], states: Sequence[str]) -> None:
    """Write the states that begin at `times`; each lasts until the next, and "" is none."""
    stream.columns(entity, times, rr.StateChange.columns(state=states))


def write_span(stream: Stream, tick: int, stamp_ns: int, entity: Sequence[str], state: str) -> None:
    """Write one state that begins now."""
    stream.at(tick, stamp_ns, entity, rr.StateChange(state=state))


def lanes_view(name: str, contents: Sequence[str]) -> rrb.View:
    """Return a view of lanes, on the time axis that all views share."""
    axis = rrb.TimeAxis(link="LinkToGlobal")
    return rrb.StateTimelineView(origin="/", contents=list(contents), name=name, time_view=axis)
