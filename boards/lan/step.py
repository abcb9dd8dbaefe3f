"""A step: what a rack in lockstep sends at the end of each cycle of its adapter, with all that it
exports then."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from enum import IntFlag
from typing import NamedTuple

from xxhash import xxh3_64_intdigest as xxh3
from zenoh import ZBytes
from zenoh.ext import Int64, ZDeserializeError, z_deserialize, z_serialize

from rack.boards.lan.envelope import Envelope
from rack.boards.lan.link import Arrived

STEP_KIND = xxh3(b"rack step 2")
_CONTENT = tuple[Int64, list[str], list[tuple[str, bytes, bytes]]]
"""Length of the cycle, racks, and of each export the key, the envelope and the payload."""


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
    parts = [(export.key, export.envelope or b"", export.payload) for export in exports]
    return z_serialize((Int64(cycle_ns), list(racks), parts)).to_bytes()


def unpack_step(head: Envelope, content: bytes) -> Step | None:
    """Return the step with this head; None if it is no step, or malformed."""
    if head.kind != STEP_KIND:
        return None
    try:
        cycle_ns, racks, parts = z_deserialize(_CONTENT, ZBytes(content))
    except ZDeserializeError:
        return None
    exports = tuple(Arrived(*part) for part in parts)
    # What is left behind the last part would be ignored.
    if pack_step(cycle_ns, racks, exports) != content:
        return None
    return Step(head.launch, head.time_ns, head.flags, cycle_ns, tuple(racks), exports)
