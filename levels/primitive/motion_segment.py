"""Segments in the window of the level above, and the state that survives a restart."""

from __future__ import annotations

from math import ceil
from typing import NamedTuple

import numpy as np

from rack.levels.messages import (
    Error,
    MoveCommand,
    MoveSegment,
    SegmentKind,
)
from rack.levels.motion.path import BlendedPath


class SegmentFault(NamedTuple):
    """Why a segment cannot be done."""

    code: Error
    reason: str
    earliest: float = 0.0  # for TOO_LATE: earliest possible simulated time, s


class MotionSegment(MoveSegment):
    """A copy of one segment of a `MoveCommand`."""

    def build_path(self) -> BlendedPath:
        """Build the path of the segment.

        Raises:
            ValueError: The path is invalid.
        """
        return BlendedPath(self.waypoints[: self.count], self.blend[: self.count])

    def build_lateness_fault(self, earliest_s: float) -> SegmentFault:
        """Return the fault to report if the segment cannot be finished before `earliest_s`."""
        # Round up, so that the reported time can be met.
        earliest_s = ceil(earliest_s * 1e3) / 1e3
        return SegmentFault(
            Error.TOO_LATE,
            f"segment {self.id} is wanted by {self.by:.3f} s; the earliest is {earliest_s:.3f} s",
            earliest_s,
        )


def list_serials(command: MoveCommand) -> list[int]:
    """Return the serials of the segments in a `MoveCommand`, oldest first."""
    return list(command.segments["id"][: command.count].tolist())


def read_segment(command: MoveCommand, serial: int) -> MotionSegment:
    """Return a copy of a segment.

    Args:
        command: Command with the window.
        serial: Serial of a segment in the window.

    Raises:
        ValueError: The kind of the segment is unknown, or a number is not finite.
    """
    record = command.segments[list_serials(command).index(serial)]
    segment = MotionSegment(record.dtype)
    segment.record[...] = record
    if segment.kind not in (SegmentKind.PATH, SegmentKind.GRIPPER):
        raise ValueError(f"segment {serial}: kind {segment.kind}; valid: 1 (path), 2 (gripper)")
    if not np.isfinite([segment.by, segment.opening, segment.force]).all():
        raise ValueError(f"segment {serial}: by, opening or force is not finite")
    return segment
