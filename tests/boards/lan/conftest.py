"""The segment of a rack that exports and imports, and what stands in for its network."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import pytest

from rack.backplane.layout import Layout
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.config.resolved import resolve_layout
from rack.boards.lan.link import ReceivedMessage
from tests.boards.config.mistakes import read_config
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
def make_segment(make_segment: MakeSegment) -> MakeSegment:
    """Return a function that creates the segment of a layout; its epoch is the origin of all
    clocks, so that stamps are simulated times."""

    def make(layout: Layout, config: str = "", *, lockstep: bool = False) -> Segment:
        segment = make_segment(layout, config)
        segment.words[System.PERIOD_NS] = layout.clock_ns
        segment.words[System.LOCKSTEP] = lockstep
        return segment

    return make


@pytest.fixture(params=["realtime", "lockstep"])
def segment(make_segment: MakeSegment, rack_name: str, request: pytest.FixtureRequest) -> Segment:
    """The segment of a rack that imports."""
    config = read_config(rack_text(rack_name, "", [], "two"), [f"clock.mode={request.param}"])
    is_lockstep = request.param == "lockstep"
    return make_segment(resolve_layout(config), config.to_toml_text(), lockstep=is_lockstep)
