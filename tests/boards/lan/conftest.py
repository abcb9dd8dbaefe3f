"""The segment of a rack that exports and imports, and what stands in for its network."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import pytest

from rack.backplane.segment import Segment, unlink
from rack.backplane.words import System
from rack.boards.config.loader import loads
from rack.boards.config.resolved import wire
from rack.boards.config.toml import override, parse, to_toml
from rack.boards.lan.link import Arrived
from tests.boards.lan.racks import rack_text

EVERY = 8
"""Ticks of a cycle of the adapter, 20 ms."""
LAUNCH = 101


class Network:
    """Stands in for the link: what tests put into `come` arrives, what is sent is in `sent`."""

    def __init__(self) -> None:
        self.come: deque[Arrived] = deque()
        self.sent: list[tuple[bytes, bytes]] = []

    def subscribe(self, key: str) -> Any:
        """Return a function that yields what has come."""
        return lambda: iter([self.come.popleft() for _ in range(len(self.come))])

    def publish(self, key: str, reliable: bool = False) -> Any:
        return lambda payload, envelope: self.sent.append((payload, envelope))


@pytest.fixture(params=["realtime", "lockstep"])
def segment(rack_name: str, request: pytest.FixtureRequest) -> Iterator[Segment]:
    """The segment of a rack that imports; its epoch is the origin of all clocks, so that stamps are
    simulated times."""
    config = loads(
        to_toml(
            override(
                parse(rack_text(rack_name, "", [], "two")), [f"clock.mode={request.param}"], []
            )
        )
    )
    made = Segment.create(wire(config), config.text())
    made.words[System.PERIOD_NS], made.words[System.LOCKSTEP] = (
        2_500_000,
        request.param == "lockstep",
    )
    yield made
    made.close()
    unlink(rack_name)
