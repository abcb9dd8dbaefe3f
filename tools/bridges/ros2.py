"""A rack as a node of ROS 2.

It publishes the topics of `rack.tools.ecosystem.ros_messages`. The service `/rack/emergency_stop`
sets the emergency stop, which only `rack estop --reset` clears. A rack with an external host board
for motion requests takes `/joint_trajectory`.
"""

from __future__ import annotations

import os
import time

from rack.backplane.errors import MailboxError
from rack.backplane.lines import UtilityLines
from rack.backplane.segment import Segment
from rack.levels.references import find_class
from rack.tools.bridges.bridge import Tell
from rack.tools.bridges.ros_node import RESPONSE, STOP_SERVICE, RosNode
from rack.tools.bridges.topics import Publisher, TopicBridge
from rack.tools.bridges.trajectory import TYPE, TrajectoryFollower, find_motion_board
from rack.tools.console.answer import Failure
from rack.tools.ecosystem.ros_messages import STORE, build, convert_name

NODES = {
    "rmw_zenoh_cpp": "rack.tools.bridges.zenoh_node:ZenohNode",
    "rmw_cyclonedds_cpp": "rack.tools.bridges.dds_node:DdsNode",
}
"""Class of the node for each transport, named as in ROS. The first one is the default."""
TRAJECTORY_TOPIC = "/joint_trajectory"
QUIET_S = 1.0
"""Shortest time between two lines about the same topic."""


class Ros2Bridge(TopicBridge):
    """A rack as a node of ROS 2."""

    def __init__(self, segment: Segment, tell: Tell) -> None:
        self._told: dict[str, float] = {}
        self._show = tell
        self._lines = UtilityLines(segment)
        self._follower: TrajectoryFollower | None = None
        transport = os.environ.get("RMW_IMPLEMENTATION") or next(iter(NODES))
        if transport not in NODES:
            why = f"must be {' or '.join(NODES)}"
            raise Failure(f"RMW_IMPLEMENTATION = {transport}: {why}", 2)
        name = convert_name(f"rack_{segment.rack}")
        self._node = find_class(NODES[transport], RosNode)(name, self._tell_rarely)
        super().__init__(segment)
        self._node.serve(self._stop)
        trajectories = self._take_trajectories(segment)
        text = f"{transport}, domain {self._node.domain}: {len(self.publishers)} topics"
        tell(f"{text}, {STOP_SERVICE}, {trajectories}{self._node.describe_state()}")

    def advertise(self, topic: str, kind: str) -> Publisher:
        """Publish on a topic."""
        return self._node.advertise(topic, kind)

    def _stop(self) -> bytes:
        """Set the emergency stop, and return the encoded response."""
        self._lines.latch_emergency_stop()
        self._tell_rarely(f"{STOP_SERVICE}: the emergency stop is set")
        response = build(RESPONSE, True, "latched; rack estop --reset clears it")
        return bytes(STORE.serialize_cdr(response, RESPONSE))

    def _take_trajectories(self, segment: Segment) -> str:
        """Take trajectories if the rack can follow them. Returns a text that says so."""
        why = "the rack has no external host board for motion requests"
        if (wiring := find_motion_board(segment)) is not None:
            try:
                self._follower = TrajectoryFollower(segment, wiring, self._tell_rarely)
                self._node.subscribe(TRAJECTORY_TOPIC, TYPE, self._follower.take_message)
                return TRAJECTORY_TOPIC
            except MailboxError as error:
                why = str(error)
        return f"no {TRAJECTORY_TOPIC}: {why}"

    def _tell_rarely(self, text: str) -> None:
        """Show the user a line, unless another one about the same topic was shown just now."""
        about = text.partition(": ")[0]
        now = time.monotonic()
        if now - self._told.get(about, -QUIET_S) >= QUIET_S:
            self._told[about] = now
            self._show(text)

    def advance(self, tick: int) -> None:
        """Send diagnostics, and process what has been received."""
        super().advance(tick)
        for poll in self._node.polls:
            poll()

    def close(self) -> None:
        """Leave the network."""
        if self._follower is not None:
            self._follower.close()
        self._node.close()
