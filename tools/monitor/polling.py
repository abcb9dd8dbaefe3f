"""Repeated readings of a running rack."""

from __future__ import annotations

import threading
from collections.abc import Iterator

from rack.backplane.segment import Segment
from rack.tools.console.interrupt import INTERRUPT


def poll_run(segment: Segment, interval_s: float) -> Iterator[bool]:
    """Yield at regular intervals whether the run is over, until it is or a signal arrives.

    Args:
        segment: The rack.
        interval_s: Time between two readings.
    """
    ended = threading.Event()
    is_last = False
    with INTERRUPT.stop_orderly(ended.set):
        while not is_last:
            # Read this before the caller reads the rack, so that its last reading is complete.
            is_over = segment.run_is_over
            is_last = is_over or ended.wait(interval_s)
            yield is_over
