"""A node of ROS 2 over zenoh, with the keys, liveliness tokens and attachments of rmw_zenoh.

A topic is the key `DOMAIN/TOPIC/TYPE/HASH`. Other nodes learn of a publisher, subscriber or service
by its liveliness token,
`@ros2_lv/DOMAIN/ZID/NODE/ID/KIND/ENCLAVE/NAMESPACE/NAME/TOPIC/TYPE/HASH/QOS`. A message has an
attachment: sequence number, time stamp, and the hash of the sender's token.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any, NamedTuple

import zenoh
from xxhash import xxh3_128_intdigest

from rack.backplane.json_text import encode_json
from rack.tools.bridges.bridge import Tell
from rack.tools.bridges.topics import Publisher
from rack.tools.console.answer import Failure
from rack.tools.ecosystem.ros_messages import RosMessage

CONFIG_VARIABLE = "ZENOH_SESSION_CONFIG_URI"
"""Environment variable with the path of a configuration of zenoh, as for rmw_zenoh."""
ROUTER = "tcp/localhost:7447"
"""Endpoint of the router, which `ros2 run rmw_zenoh_cpp rmw_zenohd` starts."""
SETTINGS = {
    "connect/endpoints": [ROUTER],
    "connect/timeout_ms": -1,
    "connect/exit_on_failure": False,
    "listen/endpoints": ["tcp/localhost:0"],
    "open/return_conditions/connect_scouted": False,
    "scouting/multicast/enabled": False,
}
"""Differences between the sessions of rmw_zenoh and of zenoh."""
QOS = "::,10:,:,:,,"
"""Quality of service in a token: reliable, volatile, the last 10 messages."""
MAX_DOMAIN = 232
MAX_WAITING = 16
"""Number of messages or requests that wait for `poll`. Older ones are dropped."""


class RosType(NamedTuple):
    """A message or service type, such as `sensor_msgs/msg/JointState`, and its hash."""

    name: str
    hash: str

    @property
    def key(self) -> str:
        """Type and hash as in a key, `sensor_msgs::msg::dds_::JointState_/RIHS01_...`."""
        package, kind, name = self.name.split("/")
        return f"{package}::{kind}::dds_::{name}_/{self.hash}"


class RosNode:
    """A node. What it receives waits until `poll`.

    Args:
        name: Name of the node.
        tell: Shows the user a line.

    Raises:
        Failure: `ROS_DOMAIN_ID` is invalid, or the session cannot be opened.
    """

    def __init__(self, name: str, tell: Tell) -> None:
        self._name = name
        self._tell = tell
        self.domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        if not self.domain.isdecimal() or int(self.domain) > MAX_DOMAIN:
            raise Failure(f"ROS_DOMAIN_ID = {self.domain}: must be from 0 to {MAX_DOMAIN}", 2)
        config = zenoh.Config()
        try:
            if path := os.environ.get(CONFIG_VARIABLE):
                config = zenoh.Config.from_file(path)
            else:
                for key, value in SETTINGS.items():
                    config.insert_json5(key, encode_json(value))
            # Zenoh would leave its segments behind.
            config.insert_json5("transport/shared_memory/enabled", "false")
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise Failure(f"zenoh: {' '.join(str(error).split())}") from None
        self._ids = count()
        self._declared: list[Any] = []
        self._polls: list[Callable[[], None]] = []
        self._declare_token("NN")

    def _declare_token(self, kind: str, topic: str = "", of_type: RosType | None = None) -> bytes:
        """Declare the liveliness token of an entity, and return the entity's GID, 16 bytes."""
        place = [self._session.zid(), 0, next(self._ids), kind, "%", "%", self._name]
        if of_type is not None:
            place += [topic.replace("/", "%"), of_type.key, QOS]
        token = "/".join(["@ros2_lv", self.domain, *map(str, place)])
        self._declared.append(self._session.liveliness().declare_token(token))
        return xxh3_128_intdigest(token.encode()).to_bytes(16, "little")

    def advertise(self, topic: str, of_type: RosType) -> Publisher:
        """Publish on a topic."""
        publisher: Any = self._session.declare_publisher(f"{self.domain}{topic}/{of_type.key}")
        gid = self._declare_token("MP", topic, of_type)
        numbers = count(1)

        def publish(message: RosMessage) -> None:
            head = struct.pack("<qqB", next(numbers), time.time_ns(), len(gid))
            publisher.put(bytes(message.data), attachment=head + gid)

        return Publisher(lambda: bool(publisher.matching_status.matching), publish)

    def subscribe(self, topic: str, of_type: RosType, take: Callable[[bytes], None]) -> None:
        """Pass the newest message of a topic to `take`, as CDR. Other types are reported."""
        # Subscribe to all types, so that a sender of another version is not ignored silently.
        channel: Any = self._session.declare_subscriber(
            f"{self.domain}{topic}/*/*", zenoh.handlers.RingChannel(MAX_WAITING)
        )
        self._declare_token("MS", topic, of_type)

        def take_newest() -> None:
            newest = None
            for sample in _take_waiting(channel):
                if str(sample.key_expr).endswith(of_type.key):
                    newest = sample
                else:
                    why = f"{sample.key_expr} is of another type or version; valid: {of_type.key}"
                    self._tell(f"{topic}: {why}")
            if newest is not None:
                take(newest.payload.to_bytes())

        self._polls += [take_newest]

    def serve(self, service: str, of_type: RosType, answer: Callable[[], bytes]) -> None:
        """Call `answer` for each request to a service, and reply with the CDR that it returns."""
        channel: Any = self._session.declare_queryable(
            f"{self.domain}{service}/{of_type.key}",
            zenoh.handlers.RingChannel(MAX_WAITING),
            complete=True,
        )
        self._declare_token("SS", service, of_type)

        def reply_all() -> None:
            for query in _take_waiting(channel):
                with query:
                    # A reply carries the sequence number and the GID of its request.
                    head = query.attachment.to_bytes() if query.attachment else b""
                    stamp = struct.pack("<q", time.time_ns())
                    query.reply(query.key_expr, answer(), attachment=head[:8] + stamp + head[16:])

        self._polls += [reply_all]

    def poll(self) -> None:
        """Process the messages and requests that were received."""
        for poll in self._polls:
            poll()

    def close(self) -> None:
        """Close the session. Other nodes notice it at once."""
        self._session.close()  # type: ignore[no-untyped-call]

    def describe_router(self) -> str:
        """Return a note if the router is missing, without which no other node finds this one."""
        if self._session.info.routers_zid() or CONFIG_VARIABLE in os.environ:
            return ""
        return f"; waiting for the router of ROS at {ROUTER}"


def _take_waiting(channel: Any) -> Iterator[Any]:
    """Remove and yield what waits in a channel, so much that a flood cannot prolong the pass."""
    for _ in range(MAX_WAITING):
        if (item := channel.try_recv()) is None:
            return
        yield item
