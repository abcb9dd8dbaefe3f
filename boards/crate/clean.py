"""Removal of the remains of killed racks; a rack in use is never removed."""

from __future__ import annotations

import os
from collections.abc import Collection
from contextlib import closing, suppress

from rack.backplane.address_map import HEAD_SIZE
from rack.backplane.byte_lock import ByteLock
from rack.backplane.errors import RackInUseError, SegmentError
from rack.backplane.segment import Segment, racks, shm_path, stranger, unlink
from rack.backplane.words import Head


def remove_dead(rack: str) -> bool:
    """Remove the segment of a rack that is not running; return whether there was one.

    Raises `RackInUseError` if its launcher is alive, and `SegmentError` if the segment is another
    user's or not a file.
    """
    if rack not in racks():
        return False
    with suppress(FileNotFoundError):
        # A file without room for a head is in no process's use: launches link whole segments to
        # their names.
        if stranger(rack) is None and shm_path(rack).stat().st_size < HEAD_SIZE:
            unlink(rack)
            return True
    try:
        segment = Segment.open(rack)
    except SegmentError:
        if rack in racks():
            raise
        # Another program has just removed it.
        return False
    with closing(segment):
        if segment.launcher_is_alive:
            raise RackInUseError(
                f"rack '{rack}' is already running, launched by {segment.launcher_text}; stop it,"
                " or choose another name"
            )
        # If two programs find the same dead rack, only one removes it. Otherwise the slower one
        # would remove the rack that the faster one has meanwhile launched under the same name.
        with closing(ByteLock(segment.fd, 8 * Head.MAGIC)) as removal:
            if not removal.take() or not segment.has_its_name:
                return False
            unlink(rack)
            return True


def remove_own(rack: str | None = None, killed: Collection[int] = ()) -> None:
    """Remove the racks launched by this process or by one that it has `killed`, or one of them, in
    any state.
    """
    for name in racks() if rack is None else [rack]:
        with suppress(SegmentError):
            segment = Segment.open(name)
            if segment.launcher in killed or (
                segment.launcher_is_alive and segment.launcher == os.getpid()
            ):
                unlink(name)
            segment.close()


def clean() -> tuple[list[str], list[str], list[str]]:
    """Remove every rack that is not running; return names removed, names in use, and a line per
    foreign entry.
    """
    removed = []
    in_use = []
    strange = []
    for rack in racks():
        try:
            if remove_dead(rack):
                removed.append(rack)
        except RackInUseError:
            in_use.append(rack)
        except SegmentError as error:
            strange.append(str(error))
    return removed, in_use, strange
