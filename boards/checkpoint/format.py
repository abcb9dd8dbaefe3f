"""A checkpoint as a file: a head that says whose it is, then blobs, with a checksum over all.

It is written by another name and renamed when it is whole, so a run that is killed leaves no half
of one.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from hashlib import blake2b
from pathlib import Path

from rack.backplane.json_text import encode_json
from rack.backplane.layout import Layout
from rack.backplane.regular_file import read_regular_file
from rack.backplane.segment import VERSION as SEGMENT_VERSION
from rack.boards.errors import CheckpointError

MAGIC = b"RACKCKPT"
VERSION = 3
FOLDER = "checkpoints"
"""Where they lie in the folder of a run."""
NAME = "{:09d}.checkpoint"
ATTRIBUTES = ".attributes"
"""Suffix of the file, next to a checkpoint, with the attributes of a task's level as JSON."""
_HEAD = struct.Struct("<8sIII")
"""Magic, version, size of the head as JSON, and CRC of that size and all that follows."""
MOST_BYTES = 1 << 32
"""Largest checkpoint that is read."""
_OF_MACHINE = ("core", "priority", "slot")
"""Properties of a task that depend on the machine and on its other racks."""


@dataclass(frozen=True)
class PartState:
    """The state of one process: `shape` of its parts, and what has changed in them."""

    shape: str
    changed: bytes


@dataclass(frozen=True)
class Checkpoint:
    """The state of a rack before `tick`: of its segment the `regions`, as address and size, with
    their contents `memory`, and of each process its `parts`."""

    tick: int
    layout: str
    regions: tuple[tuple[int, int], ...]
    memory: bytes
    parts: Mapping[str, PartState]

    def write(self, folder: Path) -> Path:
        """Write it into a folder; return its path. Raises `OSError`."""
        found = (self.memory, *(part.changed for part in self.parts.values()))
        blobs = [zlib.compress(blob, 1) for blob in found]
        head = {
            "segment": SEGMENT_VERSION,
            "tick": self.tick,
            "layout": self.layout,
            "regions": self.regions,
            "parts": {name: part.shape for name, part in self.parts.items()},
            "sizes": [len(blob) for blob in blobs],
        }
        text = encode_json(head).encode()
        body = b"".join((text, *blobs))
        path = folder / NAME.format(self.tick)
        unfinished = path.with_suffix(".unfinished")
        unfinished.write_bytes(
            _HEAD.pack(MAGIC, VERSION, len(text), zlib.crc32(body, len(text))) + body
        )
        unfinished.replace(path)
        return path


def read(path: Path) -> Checkpoint:
    """Return the checkpoint in a file. Raises `CheckpointError` for one of another version, or that
    was cut off or changed."""
    try:
        content = read_regular_file(path, MOST_BYTES)
    except OSError as error:
        raise CheckpointError(f"{path}: {error.strerror}") from None
    if len(content) < _HEAD.size or not content.startswith(MAGIC):
        raise CheckpointError(f"{path}: not a checkpoint")
    _, version, size, crc = _HEAD.unpack_from(content)
    if version != VERSION:
        raise CheckpointError(f"{path}: checkpoint version {version}; this program reads {VERSION}")
    body = content[_HEAD.size :]
    if zlib.crc32(body, size) != crc:
        raise CheckpointError(f"{path}: was cut off or changed: its checksum is wrong")
    head = json.loads(body[:size])
    if head["segment"] != SEGMENT_VERSION:
        why = f"memory of layout version {head['segment']}; this program has {SEGMENT_VERSION}"
        raise CheckpointError(f"{path}: {why}")
    blobs = []
    for length in head["sizes"]:
        blobs.append(zlib.decompress(body[size : size + length]))
        size += length
    states = zip(head["parts"].items(), blobs[1:], strict=True)
    return Checkpoint(
        tick=head["tick"],
        layout=head["layout"],
        regions=tuple((address, length) for address, length in head["regions"]),
        memory=blobs[0],
        parts={name: PartState(shape, changed) for (name, shape), changed in states},
    )


def layout_hash(layout: Layout) -> str:
    """Return a hash of what a checkpoint needs to find the same: all of a layout but the rack's
    name and the places of its tasks on this machine."""
    found = {**asdict(layout), "rack": ""}
    found["tasks"] = [
        {key: value for key, value in asdict(task).items() if key not in _OF_MACHINE}
        for task in layout.tasks
    ]
    return blake2b(encode_json(found).encode(), digest_size=16).hexdigest()


def checkpoints(run: Path) -> dict[int, Path]:
    """Return the checkpoints of a run, by tick, the earliest first."""
    found = (run / FOLDER).glob("*.checkpoint")
    return {int(path.stem): path for path in sorted(found) if path.stem.isdecimal()}
