"""A running rack to look at and to command."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Self

from rack.backplane.segment import Segment
from rack.tools.console.interrupt import INTERRUPT


class LocalRack:
    """A rack on this machine, in a context. Raises `SegmentError` when there is none."""

    def __init__(self, rack: str) -> None:
        self.segment = Segment.attach(rack)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.segment.close()


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
