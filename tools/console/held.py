"""Describes why requests to a rack wait while it is held between two ticks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.words import System

if TYPE_CHECKING:
    from rack.backplane.segment import Segment


def describe_wait(segment: Segment) -> str:
    """Return the reason why requests to a rack wait. Empty if the rack is not held."""
    tick = segment.words[System.HELD] - 1
    if tick < 0:
        return ""
    return f"waits: the rack is held before tick {tick}; 'rack step {segment.rack}' continues it"
