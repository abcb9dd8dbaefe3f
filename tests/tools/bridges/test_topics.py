"""Tests what all bridges to topics share, on a rack that does not run."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rack.backplane.segment import Segment, unlink_segment
from rack.backplane.trace import RECORD
from rack.boards.config import load, resolve_layout
from rack.tools.bridges.topics import Publisher, TopicBridge
from rack.tools.ecosystem.ros_messages import STORE, RosMessage


class KeepingBridge(TopicBridge):
    """Keeps all messages."""

    def __init__(self, segment: Segment) -> None:
        self.messages: list[RosMessage] = []
        super().__init__(segment)

    def advertise(self, topic: str, kind: str) -> Publisher:
        return Publisher(lambda: True, self.messages.append)

    def close(self) -> None: ...


def test_the_cycles_of_each_second_are_counted_once(small: Path, rack_name: str) -> None:
    rows = np.zeros(1300, RECORD)
    rows["tick"] = np.arange(1300)
    config = load(small, [f"name={rack_name}"])
    segment = Segment.create(resolve_layout(config), config.to_toml_text())
    bridge = KeepingBridge(segment)
    counts = []
    # A second has 400 ticks: one is complete, then one and a part of the next, then that one.
    for start, end in ((0, 400), (400, 900), (900, 1300)):
        bridge.show_rows("lower", rows[start:end])
        bridge.advance(end)
        bridge.advance(end)
        counts.append(len(bridge.messages))
    unlink_segment(segment.rack)
    segment.close()
    assert counts == [1, 2, 3]
    for message in bridge.messages:
        (status,) = STORE.deserialize_cdr(message.data, message.topic.type_name).status
        assert status.message == "0 missed, 0 skipped of 400 cycles"
