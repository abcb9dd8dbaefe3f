"""What a bridge needs of the network of ROS 2, whichever middleware carries it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from rack.tools.ecosystem.ros_messages import STORE
from rack.tools.ros2.topics import Publisher

MAX_BYTES = 1 << 20
"""Longest message that is taken from the network."""


class RosType(NamedTuple):
    """A message or service type, such as `sensor_msgs/msg/JointState`, and its hash."""

    name: str
    hash: str

    @property
    def dds_name(self) -> str:
        """Name of the type on the wire, as in `sensor_msgs::msg::dds_::JointState_`."""
        package, kind, name = self.name.split("/")
        return f"{package}::{kind}::dds_::{name}_"


def find_type(name: str) -> RosType:
    """Return a type of `STORE`, or a service."""
    return RosType(name, STORE.hash_rihs01(name))


class Transport(Protocol):
    """A node of ROS 2. The functions that the methods take are called in `poll`."""

    @property
    def description(self) -> str:
        """Middleware and domain, for the user."""

    def advertise(self, topic: str, kind: RosType) -> Publisher:
        """Publish on a topic."""

    def subscribe(self, topic: str, kind: RosType, take: Callable[[bytes], None]) -> None:
        """Pass the newest message of a topic to `take`, as CDR with its encapsulation header."""

    def serve(self, service: str, kind: RosType, answer: Callable[[], bytes]) -> None:
        """Call `answer` for each request to a service, and reply with the CDR that it returns."""

    def poll(self) -> None:
        """Process what has been received."""

    def close(self) -> None:
        """Leave the network."""
