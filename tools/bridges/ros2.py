"""A rack as a node of ROS 2.

It publishes the topics of `rack.tools.ecosystem.ros_messages`. The service `/rack/emergency_stop`
sets the emergency stop, which only `rack estop --reset` clears. A rack with an external host board
for motion requests takes `/joint_trajectory`.
"""

from __future__ import annotations

import time

from rosbags.typesys import get_types_from_msg

from rack.backplane.errors import MailboxError
from rack.backplane.lines import UtilityLines
from rack.backplane.segment import Segment
from rack.tools.bridges.bridge import Tell
from rack.tools.bridges.ros_node import RosNode, RosType
from rack.tools.bridges.topics import Publisher, TopicBridge
from rack.tools.bridges.trajectory import TYPE, TrajectoryFollower, find_motion_board
from rack.tools.ecosystem.ros_messages import STORE, build, convert_name

STOP_SERVICE = "/rack/emergency_stop"
TRIGGER = RosType(
    "std_srvs/srv/Trigger",
    "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
)
RESPONSE = "std_srvs/msg/Trigger_Response"
STORE.register(get_types_from_msg("bool success\nstring message", RESPONSE))
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
        self._node = RosNode(convert_name(f"rack_{segment.rack}"), self._tell_rarely)
        super().__init__(segment)
        self._node.serve(STOP_SERVICE, TRIGGER, self._stop)
        trajectories = self._take_trajectories(segment)
        text = f"rmw_zenoh, domain {self._node.domain}: {len(self.publishers)} topics"
        tell(f"{text}, {STOP_SERVICE}, {trajectories}{self._node.describe_router()}")

    def advertise(self, topic: str, kind: str) -> Publisher:
        """Publish on a topic."""
        return self._node.advertise(topic, RosType(kind, STORE.hash_rihs01(kind)))

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
                take = self._follower.take_message
                kind = RosType(TYPE, STORE.hash_rihs01(TYPE))
                self._node.subscribe(TRAJECTORY_TOPIC, kind, take)
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
        self._node.poll()

    def close(self) -> None:
        """Leave the network."""
        if self._follower is not None:
            self._follower.close()
        self._node.close()
