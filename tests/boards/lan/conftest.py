"""The segment of a rack that exports and imports, and what stands in for its network."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from rack.backplane.layout import Layout
from rack.backplane.segment import Segment, unlink_segment
from rack.backplane.words import System
from rack.boards.config.loader import load_text
from rack.boards.config.resolved import resolve_layout
from rack.boards.config.toml import apply_settings, parse_tables, to_toml
from rack.boards.lan.link import ReceivedMessage
from tests.boards.lan.racks import rack_text

MakeSegment = Callable[..., Segment]
EVERY = 8
"""Ticks of a cycle of the adapter, 20 ms."""
LAUNCH = 101


class Network:
    """Stands in for the link: what tests put into `come` arrives, what is sent is in `sent`."""

    def __init__(self) -> None:
        self.come: deque[ReceivedMessage] = deque()
        self.sent: list[tuple[bytes, bytes]] = []

    def subscribe(self, key: str) -> Any:
        """Return a function that yields what has come."""
        return lambda: iter([self.come.popleft() for _ in range(len(self.come))])

    def publish(self, key: str, reliable: bool = False) -> Any:
        return lambda payload, envelope: self.sent.append((payload, envelope))


@pytest.fixture
def make_segment() -> Iterator[MakeSegment]:
    """Return a function that creates the segment of a layout; its epoch is the origin of all
    clocks, so that stamps are simulated times."""
    made = []

    def make(layout: Layout, config: str = "", *, lockstep: bool = False) -> Segment:
        made.append(segment := Segment.create(layout, config))
        segment.words[System.PERIOD_NS] = layout.clock_ns
        segment.words[System.LOCKSTEP] = lockstep
        return segment

    yield make
    for segment in made:
        segment.close()
        unlink_segment(segment.rack)


@pytest.fixture(params=["realtime", "lockstep"])
def segment(make_segment: MakeSegment, rack_name: str, request: pytest.FixtureRequest) -> Segment:
    """The segment of a rack that imports."""
    tables = parse_tables(rack_text(rack_name, "", [], "two"))
    settings = [f"clock.mode={request.param}"]
    config = load_text(to_toml(apply_settings(tables, settings, [])))
    is_lockstep = request.param == "lockstep"
    return make_segment(resolve_layout(config), config.to_toml_text(), lockstep=is_lockstep)
