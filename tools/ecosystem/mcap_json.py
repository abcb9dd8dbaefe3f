"""Export of a recording to MCAP, for other viewers.

Each mailbox is a channel with JSON messages and a JSON schema that contains units and meanings. The
log time of a message is simulated time since the start of the run; its publish time is the
wall-clock time at which it was written. Events have their own channel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from heapq import merge
from pathlib import Path

from mcap.writer import Writer

from rack.backplane.json_text import encode_json
from rack.backplane.layout import MailboxSpec
from rack.tools.console.answer import Document
from rack.tools.recording.file_names import CONFIG
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import list_signals

EVENTS = "events"
EVENT_SCHEMA = {
    "type": "object",
    "properties": {
        name: {"type": "string"} for name in ("kind", "board", "code", "text", "subject")
    },
}
SCHEMA_ENCODING = "jsonschema"
BLOCK_MESSAGES = 1024
"""Number of messages of a mailbox that are converted to JSON in one step."""


ChannelMessage = tuple[int, int, int, int, bytes]
"""A message of a channel: its log time in ns of simulated time since the start of the run, channel,
sequence number, publication time in ns of the wall clock, and data. It sorts by its log time.
"""


def export_recording(
    recording: Recording, path: Path, show_progress: Callable[[float], None]
) -> int:
    """Write a recording as an MCAP file.

    Args:
        recording: The recording.
        path: File to write.
        show_progress: Called with the completed fraction, 0 to 1.

    Returns:
        Number of messages in the file.
    """
    boxes = {box.name: box for box in recording.layout.mailboxes}
    boxes_recorded = [boxes[name] for name in recording.mailboxes]
    total = sum(len(recording.read_signal(box.name, "serial")) for box in boxes_recorded)
    count = 0
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(library="nasrem-rack")
        writer.add_metadata("rack", {"name": recording.layout.rack, CONFIG: recording.config})
        channels = [
            _register_channel(writer, box.name, box.message, _build_schema(box))
            for box in boxes_recorded
        ]
        streams = [
            _encode_messages(recording, *pair)
            for pair in zip(boxes_recorded, channels, strict=True)
        ]
        events = _register_channel(writer, EVENTS, "event", EVENT_SCHEMA)
        for log_ns, channel, sequence, publish_ns, data in merge(
            _encode_events(recording, events), *streams
        ):
            writer.add_message(channel, log_ns, data, publish_ns, sequence)
            count += 1
            if count % BLOCK_MESSAGES == 0:
                show_progress(count / total)
        writer.finish()  # type: ignore[no-untyped-call]
    return count


def _register_channel(writer: Writer, topic: str, message: str, schema: Document) -> int:
    """Register a channel and its schema in the file, and return the id of the channel."""
    schema_id = writer.register_schema(message, SCHEMA_ENCODING, encode_json(schema).encode())
    return writer.register_channel(topic, "json", schema_id)


def _build_schema(box: MailboxSpec) -> Document:
    """Return the JSON schema of a mailbox's messages.

    Nested fields are flattened and get dotted names, as in the parquet files.
    """
    head = {
        "serial": {"type": "integer", "description": "of the message, rising by one"},
        "tick": {"type": "integer", "description": "release of the cycle that wrote it"},
    }
    for signal in list_signals(box):
        field: Document = {"type": signal.json_type}
        for _ in signal.shape:
            field = {"type": "array", "items": field}
        field["description"] = f"{signal.spec.meaning} ({signal.unit})".removesuffix(" ()")
        head[".".join(signal.path)] = field
    return {"type": "object", "properties": head}


def _encode_messages(
    recording: Recording, box: MailboxSpec, channel: int
) -> Iterator[ChannelMessage]:
    """Yield the recorded messages of a mailbox as JSON, oldest first."""
    rows = recording.read_rows(box.name)
    signals = list_signals(box)
    names = ["serial", "tick", *(".".join(signal.path) for signal in signals)]
    clock_ns = recording.layout.clock_ns
    wall_ns = recording.launch.wall_offset_ns
    for first in range(0, len(rows), BLOCK_MESSAGES):
        block = rows[first : first + BLOCK_MESSAGES]
        heads = [block[name].tolist() for name in ("serial", "tick")]
        columns = [*heads, *(signal.extract_plain(block["message"]) for signal in signals)]
        for values, stamp_ns in zip(
            zip(*columns, strict=True), block["stamp_ns"].tolist(), strict=True
        ):
            serial, tick = values[:2]
            data = encode_json(dict(zip(names, values, strict=True))).encode()
            sequence = serial & 0xFFFFFFFF
            yield tick * clock_ns, channel, sequence, stamp_ns + wall_ns, data


def _encode_events(recording: Recording, channel: int) -> Iterator[ChannelMessage]:
    """Yield the events of the run as JSON, oldest first. Events without a tick are left out."""
    ticked = [event for event in recording.events if event.get("tick", -1) >= 0]
    clock_ns = recording.layout.clock_ns
    for number, event in enumerate(ticked):
        data = encode_json(event).encode()
        yield event["tick"] * clock_ns, channel, number, event["time_ns"], data
