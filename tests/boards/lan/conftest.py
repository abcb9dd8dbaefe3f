"""The segment of a rack that exports and imports, and what stands in for its network."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import pytest

from rack.backplane.segment import Segment, unlink_segment
from rack.backplane.words import System
from rack.boards.config.loader import load_text
from rack.boards.config.resolved import resolve_layout
from rack.boards.config.toml import apply_settings, parse_tables, to_toml
from rack.boards.lan.link import ReceivedMessage
from tests.boards.lan.racks import rack_text

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


@pytest.fixture(params=["realtime", "lockstep"])
def segment(rack_name: str, request: pytest.FixtureRequest) -> Iterator[Segment]:
    """The segment of a rack that imports; its epoch is the origin of all clocks, so that stamps are
    simulated times."""
    config = load_text(
        to_toml(
            apply_settings(
                parse_tables(rack_text(rack_name, "", [], "two")),
                [f"clock.mode={request.param}"],
                [],
            )
        )
    )
    made = Segment.create(resolve_layout(config), config.to_toml_text())
    made.words[System.PERIOD_NS], made.words[System.LOCKSTEP] = (
        2_500_000,
        request.param == "lockstep",
    )
    yield made
    made.close()
    unlink_segment(rack_name)
