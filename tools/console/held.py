"""Describes a rack that is held between two ticks, where requests wait."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.words import System

if TYPE_CHECKING:
    from rack.backplane.segment import Segment


def describe_wait(segment: Segment) -> str:
    """Describe how long a request to the rack must wait. Empty if the rack is not held."""
    tick = segment.words[System.HELD] - 1
    if tick < 0:
        return ""
    return f"waits: the rack is held before tick {tick}; 'rack step {segment.rack}' continues it"
