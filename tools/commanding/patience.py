"""Waiting for a rack, with a bound and a word to whoever waits."""

from __future__ import annotations

import sys
import time

from rack.backplane.segment import Segment
from rack.backplane.words import Run, System

LOOK_S = 0.001
SILENT_S = 5.0
"""Time without a tick after which nobody waits any more."""
NOTE_S = 1.5
"""Waiting that is worth a word on stderr."""


class Patience:
    """Waits as long as the rack gives out ticks; after a while it says, once, for what."""

    def __init__(self, segment: Segment, what: str) -> None:
        self._segment, self._words, self._what = segment, segment.words, what
        self._tick, self._changed = self._words[System.TICK], time.monotonic()
        self._note_at: float | None = self._changed + NOTE_S

    def look_again(self) -> bool:
        """Wait a moment; False when no tick has come for too long."""
        time.sleep(LOOK_S)
        now, tick = time.monotonic(), self._words[System.TICK]
        if tick != self._tick:
            self._tick, self._changed = tick, now
        if self._note_at is not None and now > self._note_at:
            self._note_at = None
            print(f"{self._what}; the rack is at tick {tick}", file=sys.stderr, flush=True)
        return now - self._changed < SILENT_S

    @property
    def is_in_vain(self) -> bool:
        """Whether the run is over."""
        return self._words[System.STATE] == Run.STOPPED or not self._segment.launcher_is_alive
