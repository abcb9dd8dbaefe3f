"""Removal of the remains of killed racks; a rack in use is never removed."""

from __future__ import annotations

import os
from collections.abc import Collection
from contextlib import suppress

from rack.backplane import semaphores
from rack.backplane.byte_lock import ByteLock
from rack.backplane.errors import SegmentError
from rack.backplane.segment import Segment, racks, stranger, unlink
from rack.backplane.words import Head


def remove_dead(rack: str) -> bool:
    """Remove the segment of a rack that is not running; return whether there was one.

    Raises `SegmentError` if its launcher is alive, or the segment is another user's or not a file.
    """
    if rack not in racks():
        return False
    try:
        segment = Segment.open(rack)
    except SegmentError:
        if stranger(rack) is not None:
            raise
        # Too small for a head, so no process can be using it.
        unlink(rack)
        return True
    try:
        return _remove(segment)
    finally:
        segment.close()


def _remove(segment: Segment) -> bool:
    rack = segment.rack
    if segment.launcher_is_alive:
        raise SegmentError(
            f"rack '{rack}' is already running, launched by process {segment.launcher}; stop it, or"
            " choose another name"
        )
    removal = ByteLock(segment.fd, 8 * Head.MAGIC)
    try:
        # If two programs find the same dead rack, only one removes it. Otherwise the slower one
        # would remove the rack that the faster one has meanwhile launched under the same name.
        if not removal.take() or not segment.has_its_name:
            return False
        semaphores.unlink_all(rack)
        unlink(rack)
        return True
    finally:
        removal.close()


def remove_own(rack: str | None = None, killed: Collection[int] = ()) -> None:
    """Remove the racks launched by this process or by one that it has `killed`, or one of them, in
    any state."""
    for name in racks() if rack is None else [rack]:
        with suppress(SegmentError):
            segment = Segment.open(name)
            if segment.launcher in killed or (
                segment.launcher_is_alive and segment.launcher == os.getpid()
            ):
                semaphores.unlink_all(name)
                unlink(name)
            segment.close()


def clean() -> tuple[list[str], list[str], list[str]]:
    """Remove every rack that is not running; return names removed, names in use, and a line per
    foreign entry."""
    removed = []
    in_use = []
    strange = []
    for rack in racks():
        try:
            if remove_dead(rack):
                removed.append(rack)
        except SegmentError as error:
            strange.append(str(error)) if stranger(rack) is not None else in_use.append(rack)
    return removed, in_use, strange
