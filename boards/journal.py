"""The journal of a rack: what happens to it, as events, kept and handed on as they come."""

from __future__ import annotations

import time
from collections.abc import Callable

from rack.backplane.segment import Segment
from rack.backplane.words import Run, System
from rack.boards.events import Event, EventKind


class Journal:
    """Keeps `events`, and calls `on_event` with each. Before there is a `segment`, there is no tick."""

    def __init__(self, on_event: Callable[[Event], None] | None) -> None:
        self.events: list[Event] = []
        self.segment: Segment | None = None
        self._on_event = on_event

    def tell(
        self,
        kind: EventKind,
        board: str,
        text: str,
        code: str = "",
        at_ns: int | None = None,
        tick: int | None = None,
        subject: str = "",
    ) -> None:
        """Keep something that happens now, or that happened at CLOCK_MONOTONIC `at_ns` and `tick`."""
        now_ns = time.time_ns()
        stamp_ns = now_ns if at_ns is None else now_ns - time.monotonic_ns() + at_ns
        self.keep(Event(stamp_ns, self._tick if tick is None else tick, kind, board, text, code, subject=subject))

    def keep(self, event: Event) -> None:
        """Keep an event, and hand it on."""
        self.events.append(event)
        if self._on_event:
            self._on_event(event)

    @property
    def _tick(self) -> int:
        if self.segment is None or self.segment.words[System.STATE] == Run.STARTING:
            return -1
        return self.segment.words[System.TICK]
