"""Removal of segments that killed racks have left behind. A rack in use is never removed."""

from __future__ import annotations

import os
from collections.abc import Collection
from contextlib import closing, suppress

from rack.backplane.address_map import HEAD_SIZE
from rack.backplane.byte_lock import ByteLock
from rack.backplane.errors import RackInUseError, SegmentError
from rack.backplane.exclusive_cores import release_cores
from rack.backplane.segment import (
    Segment,
    find_foreign_kind,
    get_shm_path,
    list_racks,
    unlink_segment,
)
from rack.backplane.words import Head


def remove_dead_rack(rack: str) -> bool:
    """Remove the segment of a rack if the rack is not running.

    Returns:
        True if this call removed a segment.

    Raises:
        RackInUseError: The launcher of the rack is alive.
        SegmentError: The segment belongs to another user or is not a file.
    """
    with suppress(FileNotFoundError):
        # A file that is too short for a head is not in use, because a launch names its segment only
        # when the segment is complete.
        if find_foreign_kind(rack) is None and get_shm_path(rack).stat().st_size < HEAD_SIZE:
            unlink_segment(rack)
            return True
    try:
        segment = Segment.open(rack)
    except SegmentError:
        if rack in list_racks():
            raise
        # Another program has just removed it.
        return False
    with closing(segment):
        if segment.launcher_is_alive:
            raise RackInUseError(
                f"rack '{rack}' is already running, launched by {segment.launcher_text}; stop it,"
                " or choose another name"
            )
        # If two programs find the same dead rack, only one may remove it. Otherwise the slower
        # program would remove a rack that the faster one has launched under the same name.
        with closing(ByteLock(segment.fd, 8 * Head.MAGIC)) as removal:
            if not removal.take() or not segment.is_named:
                return False
            release_cores(rack)
            unlink_segment(rack)
            return True


def remove_own_racks(rack: str | None = None, killed: Collection[int] = ()) -> None:
    """Remove the segments of racks that this process launched, even if they are running.

    Args:
        rack: Name of a rack. None for all of them.
        killed: Ids of processes that this process has killed. Their racks are removed too.
    """
    for name in list_racks() if rack is None else [rack]:
        with suppress(SegmentError):
            segment = Segment.open(name)
            if segment.launcher in killed or (
                segment.launcher_is_alive and segment.launcher == os.getpid()
            ):
                unlink_segment(name)
            segment.close()


def remove_dead_racks() -> tuple[list[str], list[str], list[str]]:
    """Remove every rack that is not running, and release its cores.

    Returns:
        The names of the removed racks, the names of the racks in use, and an error text for each
        segment that could not be removed.
    """
    removed = []
    in_use = []
    foreign = []
    for rack in list_racks():
        try:
            if remove_dead_rack(rack):
                removed.append(rack)
        except RackInUseError:
            in_use.append(rack)
        except SegmentError as error:
            foreign.append(str(error))
    release_cores(in_use=in_use)
    return removed, in_use, foreign
