"""Bridges that send the topics of `rack.tools.ecosystem.ros_messages` while the rack runs."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.config.loader import read_stored
from rack.tools.bridges.bridge import RackBridge
from rack.tools.ecosystem.ros_messages import DIAGNOSTICS_S, RosEncoder, RosMessage, RosSource
from rack.tools.recording.current_run import EventFile, find_run_folder


class Publisher(NamedTuple):
    """Sends the messages of a topic.

    Attributes:
        has_readers: Returns True if anybody receives the messages. Others need not be encoded.
        publish: Sends a message.
    """

    has_readers: Callable[[], bool]
    publish: Callable[[RosMessage], object]


class TopicBridge(RackBridge):
    """Sends the newest message of each topic in each pass, while somebody receives the topic.

    A subclass opens its connection, then calls `__init__`.
    """

    def __init__(self, segment: Segment) -> None:
        layout = segment.layout
        words = segment.words
        # In lockstep a rack has simulated time only.
        tick_ns = words[System.TICK] * layout.clock_ns
        epoch_ns = 0 if words[System.LOCKSTEP] else time.time_ns() - tick_ns
        self.encoder = RosEncoder(layout, read_stored(segment.config), epoch_ns)
        self.publishers: dict[str, Publisher] = {}
        self._sources: dict[str, list[RosSource]] = defaultdict(list)
        for source in (*self.encoder.sources, self.encoder.log):
            if source.topic.name not in self.publishers:
                self.publishers[source.topic.name] = self.advertise(*source.topic)
            self._sources[source.ring].append(source)
        self.rings = tuple(self._sources)
        folder = find_run_folder(segment)
        self._events = None if folder is None else EventFile(folder / "events.jsonl")
        self._cycles: dict[str, list[np.ndarray]] = {task.name: [] for task in layout.tasks}
        self._second = max(1, layout.to_ticks(DIAGNOSTICS_S))

    @abstractmethod
    def advertise(self, topic: str, kind: str) -> Publisher:
        """Publish on a topic with messages of type `kind`."""

    def show_rows(self, ring: str, rows: np.ndarray) -> None:
        """Send the newest message of a mailbox, or collect the cycles of a task."""
        if ring in self._cycles:
            self._cycles[ring].append(rows)
        else:
            self._send_rows(self._sources[ring], rows[-1:])

    def advance(self, tick: int) -> None:
        """Send the diagnostics of completed seconds, and the events of a recorded run."""
        complete = tick // self._second * self._second
        for ring, blocks in self._cycles.items():
            if blocks and blocks[0]["tick"][0] < complete:
                rows = np.concatenate(blocks)
                is_due = rows["tick"] < complete
                blocks[:] = [] if is_due.all() else [rows[~is_due]]
                self._send_rows(self._sources[ring], rows[is_due])
        if self._events is not None:
            # The first reader gets the events since the start of the run.
            self._send_rows([self.encoder.log], map(vars, self._events.read_new_events()))

    def _send_rows(self, sources: Iterable[RosSource], rows: Any) -> None:
        """Encode and send what rows or events become, unless nobody receives it."""
        for source in sources:
            publisher = self.publishers[source.topic.name]
            if publisher.has_readers():
                for message in self.encoder.encode(source, rows):
                    publisher.publish(message)
