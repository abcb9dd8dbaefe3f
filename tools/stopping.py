"""Ending a rack from outside: by its stop word, and by the end of its launcher."""

from __future__ import annotations

import os

from rack.backplane.process import is_alive, readable
from rack.backplane.segment import Segment
from rack.backplane.words import Head, System


def stop_rack(rack: str, timeout_s: float) -> bool:
    """Request a rack's end and wait for its launcher to end; False when it still runs after `timeout_s`.

    Raises `SegmentError` when there is no such rack.
    """
    segment = Segment.attach(rack)
    pid, started = segment.words[Head.LAUNCHER_PID], segment.words[Head.LAUNCHER_START]
    segment.words[System.STOP_REQUEST] = 1
    segment.close()
    if not is_alive(pid, started):
        return True
    try:
        launcher = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        # The pid may have been taken over between the two looks.
        return not is_alive(pid, started) or readable(launcher, timeout_s)
    finally:
        os.close(launcher)
