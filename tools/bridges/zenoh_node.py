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
from typing import Any

import zenoh
from xxhash import xxh3_128_intdigest

from rack.backplane.json_text import encode_json
from rack.tools.bridges.bridge import Tell
from rack.tools.bridges.ros_node import MAX_WAITING, STOP_SERVICE, RosNode
from rack.tools.bridges.topics import Publisher
from rack.tools.console.answer import Failure
from rack.tools.ecosystem.ros_messages import STORE, RosMessage

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
TRIGGER_KEY = (
    "std_srvs::srv::dds_::Trigger_/"
    "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
)
QOS = "::,10:,:,:,,"
"""Quality of service in a token: reliable, volatile, the last 10 messages."""


def build_key(kind: str) -> str:
    """Return a type as in a key, `sensor_msgs::msg::dds_::JointState_/RIHS01_...`."""
    package, group, name = kind.split("/")
    return f"{package}::{group}::dds_::{name}_/{STORE.hash_rihs01(kind)}"


class ZenohNode(RosNode):
    """A node of ROS 2 that nodes with rmw_zenoh find."""

    def __init__(self, name: str, tell: Tell) -> None:
        super().__init__(name, tell)
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
        self._tokens: list[Any] = []
        self._declare_token("NN")

    def _declare_token(self, entity: str, topic: str = "", key: str = "") -> bytes:
        """Declare the liveliness token of an entity, and return the entity's GID, 16 bytes."""
        number = len(self._tokens)
        place = ["@ros2_lv", self.domain, self._session.zid(), 0, number, entity, "%", "%"]
        token = "/".join(map(str, [*place, self.name]))
        if key:
            token += f"/{topic.replace('/', '%')}/{key}/{QOS}"
        self._tokens.append(self._session.liveliness().declare_token(token))
        return xxh3_128_intdigest(token.encode()).to_bytes(16, "little")

    def advertise(self, topic: str, kind: str) -> Publisher:
        """Publish on a topic."""
        key = build_key(kind)
        publisher: Any = self._session.declare_publisher(f"{self.domain}{topic}/{key}")
        gid = self._declare_token("MP", topic, key)
        numbers = count(1)

        def publish(message: RosMessage) -> None:
            head = struct.pack("<qqB", next(numbers), time.time_ns(), len(gid))
            publisher.put(bytes(message.data), attachment=head + gid)

        return Publisher(lambda: bool(publisher.matching_status.matching), publish)

    def subscribe(self, topic: str, kind: str, take: Callable[[bytes], None]) -> None:
        """Pass the newest message of a topic to `take`."""
        key = build_key(kind)
        # Subscribe to all types, so that a sender of another version is not ignored silently.
        channel: Any = self._session.declare_subscriber(
            f"{self.domain}{topic}/*/*", zenoh.handlers.RingChannel(MAX_WAITING)
        )
        self._declare_token("MS", topic, key)

        def take_newest() -> None:
            newest = None
            for sample in _take_waiting(channel):
                if str(sample.key_expr).endswith(key):
                    newest = sample
                else:
                    self.tell_other_type(topic, sample.key_expr, key)
            if newest is not None:
                take(newest.payload.to_bytes())

        self.polls.append(take_newest)

    def serve(self, answer: Callable[[], bytes]) -> None:
        """Answer the requests to the service."""
        channel: Any = self._session.declare_queryable(
            f"{self.domain}{STOP_SERVICE}/{TRIGGER_KEY}",
            zenoh.handlers.RingChannel(MAX_WAITING),
            complete=True,
        )
        self._declare_token("SS", STOP_SERVICE, TRIGGER_KEY)

        def reply_all() -> None:
            for query in _take_waiting(channel):
                with query:
                    # A reply carries the sequence number and the GID of its request.
                    head = query.attachment.to_bytes() if query.attachment else b""
                    stamp = struct.pack("<q", time.time_ns())
                    query.reply(query.key_expr, answer(), attachment=head[:8] + stamp + head[16:])

        self.polls.append(reply_all)

    def close(self) -> None:
        """Close the session."""
        self._session.close()  # type: ignore[no-untyped-call]

    def describe_state(self) -> str:
        """Return a note if the router is missing."""
        if self._session.info.routers_zid() or CONFIG_VARIABLE in os.environ:
            return ""
        return f"; waiting for the router of ROS at {ROUTER}"


def _take_waiting(channel: Any) -> Iterator[Any]:
    """Remove and yield what waits in a channel, so much that a flood cannot prolong the pass."""
    for _ in range(MAX_WAITING):
        if (item := channel.try_recv()) is None:
            return
        yield item
