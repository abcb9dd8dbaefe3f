"""Buses for tests, removed at the end of the test."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from rack.backplane.layout import MailboxSpec, TaskSpec
from rack.backplane.segment import SHM_FOLDER, Segment, unlink_segment
from tests.backplane.bus import layout

MakeBus = Callable[..., Segment]


@pytest.fixture
def make_bus(rack_name: str) -> Iterator[MakeBus]:
    """Return a function that creates the only bus of a test, with mailboxes and tasks."""

    made: list[Segment] = []

    def make(*parts: MailboxSpec | TaskSpec, config: str = "") -> Segment:
        boxes = [part for part in parts if isinstance(part, MailboxSpec)]
        tasks = [part for part in parts if isinstance(part, TaskSpec)]
        segment = Segment.create(layout(rack_name, boxes, tasks), config)
        made.append(segment)
        return segment

    yield make
    for segment in made:
        segment.close()
    unlink_segment(rack_name)
    assert not [path.name for path in SHM_FOLDER.iterdir() if rack_name in path.name]
