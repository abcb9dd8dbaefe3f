"""A rack that is held between two ticks: what it is asked to do waits until it goes on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.words import System

if TYPE_CHECKING:
    from rack.backplane.segment import Segment


def waits(segment: Segment) -> str:
    """Return that a request waits, and until when; empty: the rack is not held."""
    tick = segment.words[System.HELD] - 1
    if tick < 0:
        return ""
    return f"waits: the rack is held before tick {tick}; 'rack step {segment.rack}' lets it go on"
