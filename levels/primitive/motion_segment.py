"""Segments of work from the window of the level above, and the executor's memory of them."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import NamedTuple

import numpy as np

from rack.backplane.mailbox.mailbox import Reading
from rack.levels.messages import (
    Error,
    JointCommand,
    MoveCommand,
    MoveSegment,
    PrimitiveStatus,
    SegmentKind,
)
from rack.levels.motion.path import BlendedPath


class SegmentFault(NamedTuple):
    """The reason why a segment cannot be done."""

    code: Error
    reason: str
    earliest: float = 0.0  # with TOO_LATE: the simulated time that could be met, s


class MotionSegment(MoveSegment):
    """A copy of one segment of a `MoveCommand`."""

    def path(self) -> BlendedPath:
        """Return the segment's path. Raises `ValueError` for an invalid one."""
        return BlendedPath(self.waypoints[: self.count], self.blend[: self.count])

    def too_late(self, earliest_s: float) -> SegmentFault:
        """Return the fault of a segment that cannot be done before `earliest_s`."""
        earliest_s = ceil(earliest_s * 1e3) / 1e3  # rounded up: the time printed here can be met
        reason = (
            f"segment {self.id} is wanted by {self.by:.3f} s; the earliest is {earliest_s:.3f} s"
        )
        return SegmentFault(Error.TOO_LATE, reason, earliest_s)


def window(command: MoveCommand) -> list[int]:
    """Return the serials of the segments in a MOVE_COMMAND, oldest first."""
    serials: list[int] = command.segments["id"][: command.count].tolist()
    return serials


def read_segment(command: MoveCommand, serial: int) -> MotionSegment:
    """Return the segment with that serial, which must be in the window.

    Raises `ValueError` for an unknown kind and for numbers that are not finite.
    """
    record = command.segments[window(command).index(serial)]
    segment = MotionSegment(record.dtype)
    segment.record[...] = record
    if segment.kind not in (SegmentKind.PATH, SegmentKind.GRIPPER):
        raise ValueError(f"segment {serial}: kind {segment.kind}; valid: 1 (path), 2 (gripper)")
    if not np.isfinite([segment.by, segment.opening, segment.force]).all():
        raise ValueError(f"segment {serial}: by, opening or force is not finite")
    return segment


@dataclass
class Memory:
    """The state with which the executor continues after a restart of its board; its own last
    messages hold it.
    """

    is_known: bool = False  # True once this level, restarts included, was in step with the servo
    done: int = 0  # newest segment done
    interrupted: int = 0  # segment that was interrupted; 0: none
    progress: float = 0.0  # part of its path done, 0 to 1
    held: int = -1  # row of the object in the gripper; -1: none
    opening: float = 0.0  # commanded to the gripper, m
    force: float = 0.0  # commanded to the gripper, N


def recall(status: Reading[PrimitiveStatus], command: Reading[JointCommand]) -> Memory:
    """Return the state in the level's own last messages; not `is_known` before the first ones."""
    if not (status.is_there and command.is_there and command.message.id):
        return Memory()
    return Memory(
        is_known=True,
        done=status.message.done,
        interrupted=status.message.current,
        progress=status.message.progress,
        held=status.message.held,
        opening=command.message.opening,
        force=command.message.force,
    )
