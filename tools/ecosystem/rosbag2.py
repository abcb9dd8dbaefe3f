"""Export of a recording to a rosbag2 folder: an MCAP file with CDR messages, and metadata.yaml.

It contains the topics of `rack.tools.ecosystem.ros_messages`, and every message of every mailbox as
a message of a type of its own: `/mailbox/servo/status` has the type `rack_msgs/msg/ServoStatus`,
whose definition in the file has units and meanings. Arrays of several dimensions are flattened,
with the last index running fastest. Log time is simulated time.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from heapq import merge
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rack.backplane.layout import FieldSpec, MailboxSpec
from rack.tools.console.answer import Failure
from rack.tools.ecosystem.ros_messages import RosEncoder, RosMessage, RosTopic, convert_name
from rack.tools.recording.recording import Recording

VERSION: Literal[8] = 8
"""Version of the format."""
HEAD = ("serial", "tick", "visible_at", "stamp_ns")
"""Columns of a mailbox that each message begins with, under names with the prefix `message_`."""
HEADER = "std_msgs/msg/Header"
SEPARATOR = "=" * 80
"""Line between two definitions."""
BLOCK_ROWS = 1024
"""Number of rows of a mailbox that are converted in one step."""


def export_bag(recording: Recording, path: Path, show_progress: Callable[[float], None]) -> int:
    """Write a recording as a rosbag2 folder.

    Args:
        recording: The recording.
        path: Folder to create.
        show_progress: Called with the completed fraction, 0 to 1.

    Returns:
        Number of messages in the bag.

    Raises:
        Failure: The recording has no messages.
    """
    boxes = [recording.layout.find_mailbox(name) for name in recording.mailboxes]
    if not boxes:
        raise Failure(f"{recording.folder}: no message is recorded, so a bag would be empty", 2)
    encoder = RosEncoder(recording.layout, recording.rack_config)
    mailboxes = MailboxEncoder(encoder)
    events = [event for event in recording.events if event.get("tick", -1) >= 0]
    streams = [
        encoder.encode(encoder.log, events),
        *(mailboxes.encode(box, recording.read_rows(box.name)) for box in boxes),
        *(
            encoder.encode(source, recording.read_rows(source.ring))
            for source in encoder.sources
            if source.ring in {*recording.mailboxes, *recording.cycles}
        ),
    ]
    ticks = [recording.read_signal(box.name, "tick")[-1] for box in boxes]
    last_ns = encoder.compute_time(int(max(ticks)))
    bag = Writer(path, version=VERSION, storage_plugin=StoragePlugin.MCAP)
    bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    connections = {}
    count = 0
    with bag:
        for message in merge(*streams, key=attrgetter("time_ns")):
            topic = message.topic
            if topic not in connections:
                connections[topic] = bag.add_connection(
                    *topic,
                    typestore=mailboxes.store,
                    msgdef=mailboxes.definitions.get(topic.type_name),
                    rihs01=mailboxes.store.hash_rihs01(topic.type_name),
                )
            bag.write(connections[topic], message.time_ns, message.data)
            count += 1
            if count % BLOCK_ROWS == 0:
                show_progress(min(1.0, message.time_ns / max(1, last_ns)))
    return count


def export_mcap(recording: Recording, path: Path, show_progress: Callable[[float], None]) -> int:
    """Write a recording as an MCAP file. The arguments are those of `export_bag`."""
    folder = path.with_name(f"{path.name}.bag")
    count = export_bag(recording, folder, show_progress)
    (folder / f"{folder.name}.mcap").rename(path)
    return count


class MailboxEncoder:
    """Encodes the messages of mailboxes, as types whose definitions are made from their fields.

    Attributes:
        store: Types of ROS, and those of the mailboxes encoded so far.
        definitions: Definitions of these types, and of the types that they contain, by name.
    """

    def __init__(self, encoder: RosEncoder) -> None:
        self.store = get_typestore(Stores.ROS2_JAZZY)
        self.definitions: dict[str, str] = {}
        self._encoder = encoder
        self._owners: dict[str, str] = {}

    def encode(self, box: MailboxSpec, rows: np.ndarray) -> Iterator[RosMessage]:
        """Yield the messages of a mailbox, oldest first. The type is declared before the first."""
        # Messages of one name may have different fields, as those of bus adapters do.
        type_name = self._name_type(box.name)
        head = ["std_msgs/Header header", *(f"int64 message_{name}" for name in HEAD)]
        definition = self._declare_type(box.name, box.fields, head)
        header, _ = self.store.generate_msgdef(HEADER, ros_version=2)
        self.definitions[type_name] = f"{definition}{SEPARATOR}\nMSG: std_msgs/Header\n{header}"
        topic = RosTopic(f"/mailbox/{convert_name(box.name)}", type_name)
        for first in range(0, len(rows), BLOCK_ROWS):
            block = rows[first : first + BLOCK_ROWS]
            ticks = block["tick"].tolist()
            headers = [self._encoder.build_header(tick) for tick in ticks]
            columns = [headers, *(block[name].tolist() for name in HEAD)]
            messages = self._build(box.name, box.fields, block["message"], columns)
            for tick, message in zip(ticks, messages, strict=True):
                data = self.store.serialize_cdr(message, type_name)
                yield RosMessage(self._encoder.compute_time(tick), topic, data)

    def _declare_type(
        self, message: str, fields: Sequence[FieldSpec], head: Sequence[str] = ()
    ) -> str:
        """Register the type of a message, and the types of its groups.

        Args:
            message: Name of the mailbox, or of the group, `MAILBOX/FIELD`.
            fields: Its fields.
            head: Definitions of fields that come first.

        Returns:
            The definition, followed by those of the groups.
        """
        lines = [*head]
        groups = ""
        for field in fields:
            kind = np.dtype(field.kind)
            base = {"S": "string", "b": "bool"}.get(kind.kind, kind.name)
            if field.fields:
                group = f"{message}/{field.name}"
                base = self._name_type(group).replace("/msg", "")
                groups += f"{SEPARATOR}\nMSG: {base}\n{self._declare_type(group, field.fields)}"
            lines += [
                f"{base} {field.name.upper()}_{name.upper()}={value}"
                for name, value in field.values
            ]
            array = "[]" if field.shape else ""
            lines.append(f"{base}{array} {field.name}  # {field.meaning} [{field.unit}]")
        definition = "\n".join(lines) + "\n"
        self.store.register(get_types_from_msg(definition, self._name_type(message)))
        return definition + groups

    def _build(
        self, message: str, fields: Sequence[FieldSpec], records: np.ndarray, head: Sequence[Any]
    ) -> list[Any]:
        """Build messages of a declared type.

        Args:
            message: Name of the mailbox or group, as in `_declare_type`.
            fields: Its fields.
            records: Values of the fields, shape (messages,).
            head: Values of the fields before them, each a list with one value for each message.
        """
        columns = [*head]
        for field in fields:
            items: Any = records[field.name].reshape(-1)
            if field.fields:
                items = self._build(f"{message}/{field.name}", field.fields, items, ())
            elif items.dtype.kind == "S":
                items = [text.decode("ascii", "replace") for text in items.tolist()]
            elif not field.shape:
                items = items.tolist()
            if field.shape:
                size = len(items) // len(records)
                items = [items[first : first + size] for first in range(0, len(items), size)]
            columns.append(items)
        kind = self.store.types[self._name_type(message)]
        return [kind(*values) for values in zip(*columns, strict=True)]

    def _name_type(self, message: str) -> str:
        """Return the type of a mailbox or group: `rack_msgs/msg/WorldModel` for `world.model`."""
        words = re.split(r"[\W_]+", message)
        name = f"rack_msgs/msg/{''.join(word.capitalize() for word in words)}"
        # `a.b_c` and `a_b.c` have the same words.
        while self._owners.setdefault(name, message) != message:
            name += "X"
        return name
