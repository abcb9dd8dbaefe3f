"""A segment of work, taken out of the window that the level above hands down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message
from rack.levels.messages import SegmentKind
from rack.levels.primitive.path import BlendedPath


@dataclass(frozen=True)
class Segment:
    """A copy of one SEGMENT; see there for units. `object` is None for none."""

    id: int
    kind: SegmentKind
    object: int | None
    touch: bool
    waypoints: NDArray[np.float64]
    blend: NDArray[np.float64]
    by: float
    opening: float
    force: float

    def path(self) -> BlendedPath:
        """Return the segment's path. Raises `ValueError` for one that cannot be."""
        return BlendedPath(self.waypoints, self.blend)


def window(command: Message) -> list[int]:
    """Return the serials of the segments that a MOVE_COMMAND holds, oldest first."""
    serials: list[int] = command.segments["id"][: command.count].tolist()
    return serials


def read_segment(command: Message, serial: int) -> Segment:
    """Return the segment of that serial, which must be in the window. Raises `ValueError` for an unknown kind
    and for numbers that are not finite.
    """
    record = command.segments[window(command).index(serial)]
    count, kind, held = int(record["count"]), int(record["kind"]), int(record["object"])
    if kind not in (SegmentKind.PATH, SegmentKind.GRIPPER):
        raise ValueError(f"segment {serial}: kind {kind}; valid: 1 (path), 2 (gripper)")
    if not np.isfinite([record["by"], record["opening"], record["force"]]).all():
        raise ValueError(f"segment {serial}: by, opening or force is not finite")
    return Segment(
        id=serial,
        kind=SegmentKind(kind),
        object=held if held >= 0 else None,
        touch=bool(record["touch"]),
        waypoints=record["waypoints"][:count].copy(),
        blend=record["blend"][:count].copy(),
        by=float(record["by"]),
        opening=float(record["opening"]),
        force=float(record["force"]),
    )
