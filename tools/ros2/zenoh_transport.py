"""ROS 2 over zenoh, with the key expressions, liveliness tokens and attachments of rmw_zenoh.

A topic is the key `DOMAIN/TOPIC/TYPE/HASH`. Other nodes learn of a publisher, subscriber or service
by its liveliness token,
`@ros2_lv/DOMAIN/ZID/NODE/ID/KIND/ENCLAVE/NAMESPACE/NAME/TOPIC/TYPE/HASH/QOS`. A message has an
attachment: sequence number, time stamp, and the hash of the sender's token.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable
from functools import partial
from itertools import count
from typing import Any

import zenoh
from xxhash import xxh3_128_intdigest

from rack.backplane.json_text import encode_json
from rack.tools.bridges.bridge import Tell
from rack.tools.console.answer import Failure
from rack.tools.ros2.topics import Publisher
from rack.tools.ros2.transport import MAX_BYTES, RosType

CONFIG_VARIABLE = "ZENOH_SESSION_CONFIG_URI"
"""Environment variable with the path of a configuration of zenoh, as for rmw_zenoh."""
ROUTER = "tcp/localhost:7447"
"""Endpoint of the router, which `ros2 run rmw_zenoh_cpp rmw_zenohd` starts."""
SETTINGS = {
    "mode": "peer",
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
MAX_WAITING = 16
"""Number of messages or requests that wait for `poll`. Older ones are dropped."""


class ZenohTransport:
    """A node of ROS 2 on zenoh.

    Args:
        name: Name of the node.
        domain: Number of the domain.
        tell: Shows the user a line.

    Raises:
        Failure: The session cannot be opened.
    """

    def __init__(self, name: str, domain: int, tell: Tell) -> None:
        self._name = name
        self._domain = domain
        self._tell = tell
        try:
            self._session = zenoh.open(_read_config())
        except (zenoh.ZError, OSError) as error:
            raise Failure(f"zenoh: {' '.join(str(error).split())}") from None
        self._ids = count()
        self._declared: list[Any] = []
        self._polls: list[Callable[[], None]] = []
        self._declare_token("NN")

    @property
    def description(self) -> str:
        """Middleware, domain, and whether there is a router."""
        text = f"zenoh (rmw_zenoh), domain {self._domain}"
        if not self._session.info.routers_zid() and CONFIG_VARIABLE not in os.environ:
            text += f"; no router at {ROUTER} yet: ros2 run rmw_zenoh_cpp rmw_zenohd"
        return text

    def _declare_token(self, kind: str, topic: str = "", ros_type: RosType | None = None) -> bytes:
        """Declare the liveliness token of an entity, and return the entity's GID, 16 bytes."""
        place = [self._domain, self._session.zid(), 0, next(self._ids), kind, "%", "%", self._name]
        if ros_type is not None:
            place += [topic.replace("/", "%"), *(ros_type.dds_name, ros_type.hash), QOS]
        token = "/".join(["@ros2_lv", *map(str, place)])
        self._declared.append(self._session.liveliness().declare_token(token))
        return xxh3_128_intdigest(token.encode()).to_bytes(16, "little")

    def _format_key(self, topic: str, *names: str) -> str:
        return "/".join([str(self._domain), topic.strip("/"), *names])

    def advertise(self, topic: str, kind: RosType) -> Publisher:
        """Publish on a topic."""
        publisher = self._session.declare_publisher(
            self._format_key(topic, kind.dds_name, kind.hash),
            congestion_control=zenoh.CongestionControl.DROP,
        )
        self._declared.append(publisher)
        gid = self._declare_token("MP", topic, kind)
        numbers = count(1)
        return Publisher(
            lambda: publisher.matching_status,
            lambda message: publisher.put(
                bytes(message.data), attachment=pack_attachment(next(numbers), gid)
            ),
        )

    def subscribe(self, topic: str, kind: RosType, take: Callable[[bytes], None]) -> None:
        """Pass the newest message of a topic to `take`. Messages of other types are reported."""
        # Subscribe to all types, so that a sender of another version is not ignored silently.
        channel: Any = self._session.declare_subscriber(
            self._format_key(topic, "*", "*"), zenoh.handlers.RingChannel(MAX_WAITING)
        )
        self._declare_token("MS", topic, kind)
        self._declared.append(channel)
        expected = self._format_key(topic, kind.dds_name, kind.hash)
        self._polls.append(partial(self._take_newest, channel, expected, take))

    def _take_newest(self, channel: Any, expected: str, take: Callable[[bytes], None]) -> None:
        """Pass on the newest message with the key `expected`, and report others."""
        newest = None
        for _ in range(MAX_WAITING):
            if (sample := channel.try_recv()) is None:
                break
            key = str(sample.key_expr)
            if key != expected:
                self._tell(f"{key}: another type or version; valid: {expected}")
            elif len(sample.payload) > MAX_BYTES:
                self._tell(f"{key}: {len(sample.payload)} bytes; valid: up to {MAX_BYTES}")
            else:
                newest = sample
        if newest is not None:
            take(newest.payload.to_bytes())

    def serve(self, service: str, kind: RosType, answer: Callable[[], bytes]) -> None:
        """Reply to the requests of a service."""
        channel: Any = self._session.declare_queryable(
            self._format_key(service, kind.dds_name, kind.hash),
            zenoh.handlers.RingChannel(MAX_WAITING),
            complete=True,
        )
        self._declare_token("SS", service, kind)
        self._declared.append(channel)

        def reply_all() -> None:
            for _ in range(MAX_WAITING):
                if (query := channel.try_recv()) is None:
                    return
                with query:
                    asked = query.attachment
                    # A reply carries the sequence number and the GID of its request.
                    head = b"" if asked is None else asked.to_bytes()
                    sent = struct.pack("<q", time.time_ns())
                    query.reply(query.key_expr, answer(), attachment=head[:8] + sent + head[16:])

        self._polls.append(reply_all)

    def poll(self) -> None:
        """Process the messages and requests that were received."""
        for poll in self._polls:
            poll()

    def close(self) -> None:
        """Close the session. Other nodes notice it at once."""
        self._session.close()  # type: ignore[no-untyped-call]


def pack_attachment(number: int, gid: bytes) -> bytes:
    """Return the attachment of a message: sequence number, time, and GID with its length."""
    return struct.pack("<qqB16s", number, time.time_ns(), len(gid), gid)


def _read_config() -> zenoh.Config:
    """Return the configuration of zenoh that the user has named, or that of rmw_zenoh."""
    if path := os.environ.get(CONFIG_VARIABLE):
        return zenoh.Config.from_file(path)
    config = zenoh.Config()
    for key, value in SETTINGS.items():
        config.insert_json5(key, encode_json(value))
    return config
