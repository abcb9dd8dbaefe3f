"""An end on cyclonedds, a DDS: reliable topics, one for each pair of machines, and its own
liveliness."""

# Annotations are not postponed: cyclonedds evaluates them.
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, uint8
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from rack.tools.lab.benches.lan_ends import (
    LEASE_MS,
    ORDER_BYTES,
    STATUS_BYTES,
    UNREAD,
    LanTask,
    Notice,
    Take,
)

QOS = Qos(
    Policy.Reliability.Reliable(duration(milliseconds=100)),
    Policy.History.KeepLast(UNREAD),
    Policy.Liveliness.Automatic(duration(milliseconds=LEASE_MS)),
)
SETTINGS = """
<CycloneDDS><Domain>
  <General>
    <Interfaces><NetworkInterface address="{own}"/></Interfaces>
    <AllowMulticast>false</AllowMulticast>
  </General>
  <Discovery>
    <ParticipantIndex>0</ParticipantIndex>
    <MaxAutoParticipantIndex>0</MaxAutoParticipantIndex>
    <SPDPInterval>5s</SPDPInterval>
    <Peers>{peers}</Peers>
  </Discovery>
</Domain></CycloneDDS>
"""
"""As with a rack, nobody looks for others: their addresses are given. A participant shows itself
every 5 s, not 30."""


@dataclass
class DdsOrder(IdlStruct):
    """What the coordinator sends. cyclonedds passes arrays of bytes on as they are."""

    data: array[uint8, ORDER_BYTES]  # type: ignore[type-arg, valid-type]


@dataclass
class DdsStatus(IdlStruct):
    """What the others send."""

    data: array[uint8, STATUS_BYTES]  # type: ignore[type-arg, valid-type]


def _taken(reader: DataReader[Any]) -> Iterator[bytes]:
    for message in reader.take(UNREAD):
        # That a writer has gone is a message, too.
        if isinstance(message, DdsOrder | DdsStatus):
            yield message.data  # type: ignore[misc]  # the array is bytes


class _Events(Listener):
    """What happens at the reader and the writer for one machine."""

    def __init__(self, other: int, notice: Notice, take: Take | None) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._other = other
        self._notice = notice
        self._take = take
        self._was_there = False

    def on_data_available(self, reader: DataReader[Any]) -> None:
        if self._take is not None:
            for content in _taken(reader):
                self._take(self._other, content)

    def on_publication_matched(self, writer: DataWriter[Any], status: Any) -> None:
        self._set(True)

    def on_liveliness_changed(self, reader: DataReader[Any], status: Any) -> None:
        # Its writer is known before it knows ours.
        if self._was_there:
            self._set(status.alive_count > 0)

    def _set(self, is_there: bool) -> None:
        self._was_there |= is_there
        self._notice(self._other, is_there)


class DdsEnd:
    """A participant, with a reader and a writer for each machine it exchanges messages with."""

    def __init__(self, task: LanTask, notice: Notice, take: Take | None) -> None:
        peers = "".join(f'<Peer address="{task.addresses[other]}"/>' for other in task.others)
        self._domain = Domain(0, SETTINGS.format(own=task.addresses[task.machine], peers=peers))
        participant = DomainParticipant(0)
        own, theirs = (DdsOrder, DdsStatus) if task.is_coordinator else (DdsStatus, DdsOrder)
        self._kind = own
        self._writers: dict[int, DataWriter[Any]] = {}
        self._readers: dict[int, DataReader[Any]] = {}
        for other in task.others:
            events = _Events(other, notice, take)
            there = Topic(participant, f"from_{other}_to_{task.machine}", theirs)
            here = Topic(participant, f"from_{task.machine}_to_{other}", own)
            self._readers[other] = DataReader(participant, there, qos=QOS, listener=events)
            self._writers[other] = DataWriter(participant, here, qos=QOS, listener=events)
        self._participant = participant

    def send(self, to: int, content: bytes) -> None:
        """Send a message to a machine."""
        self._writers[to].write(self._kind(content))  # type: ignore[arg-type]

    def taken(self) -> Iterator[tuple[int, bytes]]:
        """Yield what has come since the last call."""
        for other, reader in self._readers.items():
            for content in _taken(reader):
                yield other, content
