"""A rack as a node of ROS 2.

It publishes the topics of `rack.tools.ecosystem.ros_messages`. The service `/rack/emergency_stop`
sets the emergency stop, which only `rack estop --reset` clears. A rack with an external host board
for motion requests takes `/joint_trajectory`.
"""

from __future__ import annotations

import os
import time

from rosbags.typesys import get_types_from_msg

from rack.backplane.errors import MailboxError
from rack.backplane.lines import UtilityLines
from rack.backplane.segment import Segment
from rack.levels.references import import_reference
from rack.tools.bridges.bridge import Tell
from rack.tools.console.answer import Failure
from rack.tools.ecosystem.ros_messages import STORE, build, convert_name
from rack.tools.ros2.topics import Publisher, TopicBridge
from rack.tools.ros2.trajectory import TYPE, TrajectoryFollower, find_motion_board
from rack.tools.ros2.transport import RosType, Transport, find_type

STOP_SERVICE = "/rack/emergency_stop"
TRIGGER = RosType(
    "std_srvs/srv/Trigger",
    "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
)
RESPONSE = f"{TRIGGER.name}_Response"
STORE.register(get_types_from_msg("bool success\nstring message", RESPONSE))
TRAJECTORY_TOPIC = "/joint_trajectory"
TRANSPORTS = {
    "rmw_zenoh_cpp": "rack.tools.ros2.zenoh_transport:ZenohTransport",
    "rmw_cyclonedds_cpp": "rack.tools.ros2.dds_transport:DdsTransport",
}
"""Class for each middleware, by its name in ROS."""
QUIET_S = 1.0
"""Shortest time between two lines about the same topic."""


class Ros2Bridge(TopicBridge):
    """Connects a rack to ROS 2, over zenoh or DDS as the environment asks."""

    def __init__(self, segment: Segment, tell: Tell) -> None:
        self._told: dict[str, float] = {}
        self._show = tell
        self._lines = UtilityLines(segment)
        self._follower: TrajectoryFollower | None = None
        self._transport = open_transport(convert_name(f"rack_{segment.rack}"), self._tell_rarely)
        super().__init__(segment)
        self._transport.serve(STOP_SERVICE, TRIGGER, self._stop)
        trajectories = self._take_trajectories(segment)
        topics = len(self.publishers)
        tell(f"{self._transport.description}: {topics} topics, {STOP_SERVICE}, {trajectories}")

    def advertise(self, topic: str, kind: str) -> Publisher:
        """Publish on a topic."""
        return self._transport.advertise(topic, find_type(kind))

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
                self._transport.subscribe(TRAJECTORY_TOPIC, find_type(TYPE), take)
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
        self._transport.poll()

    def close(self) -> None:
        """Leave the network."""
        if self._follower is not None:
            self._follower.close()
        self._transport.close()


def open_transport(name: str, tell: Tell) -> Transport:
    """Open a node on the middleware that `RMW_IMPLEMENTATION` names. The default is zenoh.

    Args:
        name: Name of the node.
        tell: Shows the user a line.

    Raises:
        Failure: A variable is invalid, or the network cannot be reached.
    """
    wanted = os.environ.get("RMW_IMPLEMENTATION") or "rmw_zenoh_cpp"
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    if wanted not in TRANSPORTS:
        valid = ", ".join(TRANSPORTS)
        raise Failure(f"RMW_IMPLEMENTATION = {wanted}: must be one of {valid}", 2)
    if not domain.isdecimal() or int(domain) > 232:
        raise Failure(f"ROS_DOMAIN_ID = {domain}: must be a number from 0 to 232", 2)
    module, kind = import_reference(TRANSPORTS[wanted])
    transport: Transport = getattr(module, kind)(name, int(domain), tell)
    return transport
