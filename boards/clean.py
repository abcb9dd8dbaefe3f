"""Removing what killed racks left behind, and never a rack that is in use."""

from __future__ import annotations

import posix_ipc

from backplane import semaphores
from backplane.errors import SegmentError
from backplane.segment import Segment, racks, unlink


def remove_dead(rack: str) -> bool:
    """Remove a rack's segment when nobody runs it; return whether there was one to remove.

    Raises `SegmentError` when its launcher lives.
    """
    if rack not in racks():
        return False
    try:
        segment = Segment.attach(rack)
    except SegmentError:
        # Half made, or of another version: nobody of this program can be running it.
        unlink(rack)
        return True
    if segment.launcher_is_alive:
        raise SegmentError(
            f"rack '{rack}' runs already, launched by process {segment.launcher}; stop it, or give this one another name"
        )
    semaphores.unlink(segment.layout)
    unlink(rack)
    segment.close()
    return True


def clean() -> tuple[list[str], list[str]]:
    """Remove every rack that nobody runs; return the names removed and the names in use."""
    removed, in_use = [], []
    for rack in racks():
        try:
            if remove_dead(rack):
                removed.append(rack)
        except (SegmentError, posix_ipc.PermissionsError):
            in_use.append(rack)
    return removed, in_use
