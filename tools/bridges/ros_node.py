"""Base class of the nodes of ROS 2, one for each transport."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable

from rosbags.typesys import get_types_from_msg

from rack.tools.bridges.bridge import Tell
from rack.tools.bridges.topics import Publisher
from rack.tools.console.answer import Failure
from rack.tools.ecosystem.ros_messages import STORE

STOP_SERVICE = "/rack/emergency_stop"
"""The service of a rack, of type `std_srvs/srv/Trigger`."""
RESPONSE = "std_srvs/msg/Trigger_Response"
STORE.register(get_types_from_msg("bool success\nstring message", RESPONSE))
STORE.register(
    get_types_from_msg("uint8 structure_needs_at_least_one_member", "std_srvs/msg/Trigger_Request")
)
MAX_DOMAIN = 232
MAX_WAITING = 16
"""Number of messages or requests that wait for `poll`. Older ones are dropped."""


class RosNode(ABC):
    """A node of ROS 2. The constructor joins the network, or raises `Failure`.

    Args:
        name: Name of the node.
        tell: Shows the user a line.

    Attributes:
        polls: Functions that process what has been received, called in each pass of the bridge.
    """

    def __init__(self, name: str, tell: Tell) -> None:
        self.name = name
        self.tell = tell
        self.polls: list[Callable[[], None]] = []
        self.domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        if not self.domain.isdecimal() or int(self.domain) > MAX_DOMAIN:
            raise Failure(f"ROS_DOMAIN_ID = {self.domain}: must be from 0 to {MAX_DOMAIN}", 2)

    @abstractmethod
    def advertise(self, topic: str, kind: str) -> Publisher:
        """Publish messages of type `kind` on a topic."""

    @abstractmethod
    def subscribe(self, topic: str, kind: str, take: Callable[[bytes], None]) -> None:
        """Pass the newest message of a topic to `take`, as CDR. Other types are reported."""

    @abstractmethod
    def serve(self, answer: Callable[[], bytes]) -> None:
        """Call `answer` for each request to `STOP_SERVICE`, and reply with the CDR it returns."""

    @abstractmethod
    def close(self) -> None:
        """Leave the network. Other nodes notice it at once."""

    def describe_state(self) -> str:
        """Return a note for the user if other nodes cannot find this one yet."""
        return ""

    def tell_other_type(self, topic: str, other: str, kind: str) -> None:
        """Report a sender whose type or version is not the one of the topic."""
        self.tell(f"{topic} of another type or version: {other}; valid: {kind}")
