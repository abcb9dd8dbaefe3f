"""A node of ROS 2 over CycloneDDS, with the topics, types and QoS of rmw_cyclonedds.

A topic is named `rt/TOPIC`; a service is the topics `rq/SERVICERequest` and `rr/SERVICEReply`,
whose messages begin with the identity of the request. Types are built from the definitions in
rosbags, so that DDS can compare them with the types of other programs. Messages pass
through as bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from rosbags.interfaces import Nodetype

from rack.tools.bridges.bridge import Tell
from rack.tools.bridges.ros_node import MAX_WAITING, STOP_SERVICE, RosNode
from rack.tools.bridges.topics import Publisher
from rack.tools.console.answer import Failure
from rack.tools.ecosystem.ros_messages import STORE

HASH_KEY = "typehash="
"""Key of the hash of a type in the user data of a publisher or subscriber."""
QOS = (
    # A subscriber that does not keep up loses messages; it must not delay the others.
    Policy.Reliability.Reliable(max_blocking_time=0),
    Policy.Durability.Volatile,
    Policy.History.KeepLast(10),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
IDENTITY = {"guid": types.uint64, "seq": types.int64}
"""Fields that precede the content of a request or reply."""


class DdsNode(RosNode):
    """A node of ROS 2 that nodes with DDS find, without a name in the graph."""

    def __init__(self, name: str, tell: Tell) -> None:
        super().__init__(name, tell)
        try:
            self._participant: Any = DomainParticipant(int(self.domain))
        except DDSException:
            raise Failure("CycloneDDS found no network, or CYCLONEDDS_URI is wrong") from None

    def _create_endpoint(self, create: Any, topic: str, kind: str, digest: str = "") -> Any:
        """Create a writer or reader of a topic. Messages have a type hash as `digest`."""
        qos = Qos(*QOS, Policy.Userdata(f"{HASH_KEY}{digest};".encode() if digest else b""))
        return create(self._participant, Topic(self._participant, topic, build_type(kind)), qos=qos)

    def advertise(self, topic: str, kind: str) -> Publisher:
        """Publish on a topic."""
        writer = self._create_endpoint(DataWriter, f"rt{topic}", kind, STORE.hash_rihs01(kind))
        return Publisher(
            lambda: bool(writer.matched_sub), lambda message: _write(writer, bytes(message.data))
        )

    def subscribe(self, topic: str, kind: str, take: Callable[[bytes], None]) -> None:
        """Pass the newest message of a topic to `take`."""
        digest = STORE.hash_rihs01(kind)
        reader = self._create_endpoint(DataReader, f"rt{topic}", kind, digest)
        wire_type = build_type(kind).__idl_typename__
        # DDS connects nobody who publishes another type, so nothing would be seen of it.
        graph: Any = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)

        def take_newest() -> None:
            for other in graph.take(MAX_WAITING):
                if getattr(other, "topic_name", "") == f"rt{topic}":
                    data = other.qos[Policy.Userdata]
                    noted = data.data.decode(errors="replace") if data else ""
                    is_other = HASH_KEY in noted and digest not in noted
                    if is_other or other.type_name != wire_type:
                        given = f"{other.type_name} {noted}"
                        self.tell_other_type(topic, given, f"{wire_type} {digest}")
            for message in _take(reader)[-1:]:
                take(message)

        self.polls.append(take_newest)

    def serve(self, answer: Callable[[], bytes]) -> None:
        """Answer the requests to the service."""
        trigger = "std_srvs/srv/Trigger"
        reader = self._create_endpoint(DataReader, f"rq{STOP_SERVICE}Request", f"{trigger}_Request")
        writer = self._create_endpoint(DataWriter, f"rr{STOP_SERVICE}Reply", f"{trigger}_Response")

        def reply_all() -> None:
            for request in _take(reader):
                reply = answer()
                _write(writer, reply[:4] + request[4:20] + reply[4:])

        self.polls.append(reply_all)

    def close(self) -> None:
        """Delete all entities. The library does so when it deletes the participant."""
        self._participant.__del__()


def _write(writer: Any, data: bytes) -> None:
    """Send a message, unless a subscriber is too slow."""
    with suppress(DDSException):
        writer.write(_wrap(writer.topic.data_type, data))


def _take(reader: Any) -> list[bytes]:
    """Remove and return the messages that wait in a reader."""
    samples = reader.take(MAX_WAITING)
    return [sample.data for sample in samples if isinstance(sample, reader.topic.data_type)]


@cache
def build_type(kind: str) -> Any:
    """Return a type as the class of its messages, whose only attribute `data` is their CDR."""
    package, group, name = kind.split("/")
    fields = dict(IDENTITY) if group == "srv" else {}
    for field, node in STORE.get_msgdef(f"{package}/msg/{name}").fields:
        fields[field] = _convert_type(node)
    wire_type = f"{package}::{group}::dds_::{name}_"
    built: Any = make_idl_struct(name, wire_type, fields, dataclassify=False)
    built.serialize = lambda self, **_: self.data
    built.deserialize = built.deserialize_key = classmethod(_wrap)
    return built


def _wrap(built: Any, data: bytes) -> Any:
    """Return a message of a type."""
    message = built()
    message.data = data
    return message


def _convert_type(node: Any) -> Any:
    """Return the type of a field, given as in rosbags."""
    kind, content = node
    if kind == Nodetype.NAME:
        return build_type(content)
    # No message of a rack has arrays of a fixed size.
    library: Any = types
    if kind == Nodetype.SEQUENCE:
        return library.sequence[_convert_type(content[0])]
    return {"string": str, "bool": bool}.get(content[0]) or getattr(library, content[0])
