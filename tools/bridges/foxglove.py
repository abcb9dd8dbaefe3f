"""Serves a running rack to Foxglove: the cell as a scene, curves of the joints, timing and the log.

Besides the topics for ROS 2 there are `/cell`, the geoms of the model in the frames of `/tf`, and
`/timing/BOARD`, the times of a board's cycles.
"""

from __future__ import annotations

import os
from typing import Any

import foxglove
import numpy as np
from foxglove.channels import SceneUpdateChannel

from rack.backplane.segment import Segment
from rack.boards.config.cell import build_rack_cell
from rack.boards.config.loader import read_stored
from rack.boards.timing.trace_times import compute_response_ns, count_misses_and_skips
from rack.tools.bridges.bridge import Tell
from rack.tools.bridges.scene import build_scene
from rack.tools.bridges.topics import Publisher, TopicBridge
from rack.tools.console.answer import Failure
from rack.tools.ecosystem.ros_messages import STORE

HOST = "127.0.0.1"
PORT_VARIABLE = "FOXGLOVE_PORT"
PORT = 8765
"""Port to which Foxglove connects by default."""
MAX_PORT = 65535


class FoxgloveBridge(TopicBridge):
    """A websocket server for Foxglove. Slow clients lose messages, and delay nothing."""

    def __init__(self, segment: Segment, tell: Tell) -> None:
        self._context = foxglove.Context()
        self._new_readers = False
        super().__init__(segment)
        config = read_stored(segment.config)
        has_cell = config.robot is not None
        self._scene = build_scene(build_rack_cell(config).model) if has_cell else None
        self._cell = SceneUpdateChannel("/cell", context=self._context)
        self._timing = {
            task.name: foxglove.Channel(f"/timing/{task.name}", context=self._context)
            for task in segment.layout.tasks
        }
        port = os.environ.get(PORT_VARIABLE) or f"{PORT}"
        if not (port.isdecimal() and int(port) <= MAX_PORT):
            raise Failure(f"{PORT_VARIABLE} = {port}: must be from 0 to {MAX_PORT}", 2)
        listener: Any = self
        try:
            self._server = foxglove.start_server(
                name=segment.rack,
                host=HOST,
                port=int(port),
                server_listener=listener,
                context=self._context,
            )
        except (OSError, RuntimeError) as error:
            raise Failure(f"{PORT_VARIABLE} = {port}: {error}") from None
        tell(f"open ws://{HOST}:{self._server.port} in Foxglove")

    def advertise(self, topic: str, kind: str) -> Publisher:
        """Publish on a topic."""
        definition, _ = STORE.generate_msgdef(kind)
        schema = foxglove.Schema(name=kind, encoding="ros2msg", data=definition.encode())
        channel = foxglove.Channel(
            topic, schema=schema, message_encoding="cdr", context=self._context
        )
        return Publisher(
            channel.has_sinks,
            lambda message: channel.log(bytes(message.data), log_time=message.time_ns),
        )

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Note that somebody subscribes, and lacks what was sent before. Called by a thread."""
        self._new_readers = True

    def show_rows(self, ring: str, rows: np.ndarray) -> None:
        """Send the rows of a ring. Cycles also become points of curves."""
        super().show_rows(ring, rows)
        channel = self._timing.get(ring)
        if channel is not None and channel.has_sinks():
            missed, skipped = count_misses_and_skips(rows)
            response_ms = compute_response_ns(rows).max() * 1e-6
            values = {"response_ms": response_ms, "missed": missed, "skipped": skipped}
            channel.log(values, log_time=self.encoder.compute_time(int(rows["tick"][-1])))

    def advance(self, tick: int) -> None:
        """Send diagnostics and events, and the whole cell to new readers."""
        super().advance(tick)
        if self._new_readers and self._scene is not None:
            self._new_readers = False
            self._cell.log(self._scene, log_time=self.encoder.compute_time(tick))

    def close(self) -> None:
        """Disconnect all clients."""
        self._server.stop()
