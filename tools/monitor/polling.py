"""Repeated looks at a running rack."""

from __future__ import annotations

import threading
from collections.abc import Iterator

from rack.backplane.segment import Segment
from rack.tools.console.interrupt import INTERRUPT


def looks(segment: Segment, look_s: float) -> Iterator[bool]:
    """Yield again and again whether the run is over, until it is, or a signal asks for the end."""
    ended = threading.Event()
    is_last = False
    with INTERRUPT.orderly(ended.set):
        while not is_last:
            # Asked before the look: what is written until the end is seen.
            is_over = segment.run_is_over
            is_last = is_over or ended.wait(look_s)
            yield is_over
