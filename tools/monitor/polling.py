"""Repeated readings of a running rack."""

from __future__ import annotations

import threading
from collections.abc import Iterator

from rack.backplane.segment import Segment
from rack.tools.console.interrupt import INTERRUPT


def looks(segment: Segment, look_s: float) -> Iterator[bool]:
    """Yield at regular intervals whether the run is over, until it is or a signal arrives.

    Args:
        segment: The rack.
        look_s: Time between two readings.
    """
    ended = threading.Event()
    is_last = False
    with INTERRUPT.orderly(ended.set):
        while not is_last:
            # Read this before the caller reads messages, so that it sees all up to the end.
            is_over = segment.run_is_over
            is_last = is_over or ended.wait(look_s)
            yield is_over
