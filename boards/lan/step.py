"""A step: what a rack in lockstep sends at the end of each cycle of its adapter, with all that it
exports then."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from enum import IntFlag
from typing import NamedTuple

from xxhash import xxh3_64_intdigest as xxh3

from rack.boards.lan.envelope import Envelope
from rack.boards.lan.link import Arrived

STEP_KIND = xxh3(b"rack step 1")
_HEAD = struct.Struct("<qHH")
_PART = struct.Struct("<HHI")


class StepFlag(IntFlag):
    """What else a step says, in the flags of its envelope."""

    FIRST = 1  # this process needs the newest step of the others
    OVER = 2  # the run has ended, and this was its last step


class Step(NamedTuple):
    """One step of a rack. `cycle_ns`: length of its adapter's cycle; `racks`: those for which it
    waits."""

    launch: int
    time_ns: int
    flags: int
    cycle_ns: int
    racks: tuple[str, ...]
    exports: tuple[Arrived, ...]


def pack_step(cycle_ns: int, racks: Iterable[str], exports: Sequence[Arrived]) -> bytes:
    """Return the content of a step."""
    names = "\n".join(racks).encode()
    parts = [_HEAD.pack(cycle_ns, len(names), len(exports)), names]
    for export in exports:
        key = export.key.encode()
        envelope = export.envelope or b""
        parts += [
            _PART.pack(len(key), len(envelope), len(export.payload)),
            key,
            envelope,
            export.payload,
        ]
    return b"".join(parts)


def unpack_step(head: Envelope, content: bytes) -> Step | None:
    """Return the step with this head; None if it is no step, or malformed."""
    if head.kind != STEP_KIND:
        return None
    try:
        cycle_ns, length, count = _HEAD.unpack_from(content)
        at = _HEAD.size + length
        racks = content[_HEAD.size : at].decode().split("\n")
        exports = []
        for _ in range(count):
            lengths = _PART.unpack_from(content, at)
            start = at + _PART.size
            key = start + lengths[0]
            envelope = start + sum(lengths[:2])
            at = start + sum(lengths)
            exports.append(
                Arrived(content[start:key].decode(), content[key:envelope], content[envelope:at])
            )
    except (struct.error, UnicodeDecodeError):
        return None
    if at != len(content):
        return None
    return Step(head.launch, head.time_ns, head.flags, cycle_ns, tuple(racks), tuple(exports))
