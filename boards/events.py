"""The record of a run: its events as they happen, and how it ended."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from rack.backplane.segment import Segment
from rack.backplane.words import Run, System

EventKind = Literal[
    "launch",
    "ready",
    "start",
    "printed",
    "died",
    "stop",
    "end",
    "recorder",
    "command",
    "fault",
    "detection",
    "miss",
    "reaction",
    "recovery",
    "held",
]


@dataclass(frozen=True)
class Event:
    """Something that happened to a rack. `time_ns` is CLOCK_REALTIME, `tick` the system clock's (-1: before the run).

    For programs: `code` is an alarm's name in lower case, "begins" or "ends" of a fault, or an operator's command;
    `fault` is an entry of the fault table (-1: none); `subject` is the mailbox, joint, task or level concerned; `value`
    is the measured value, or a command's serial; `since` is the tick since which the condition holds (-1: not known).
    """

    time_ns: int
    tick: int
    kind: EventKind
    board: str
    text: str
    code: str = ""
    fault: int = -1
    subject: str = ""
    value: float = 0.0
    since: int = -1


Cause = Literal["task done", "task refused", "task failed", "time over", "stopped", "board lost", "launcher lost"]
"""A task is refused if it was never begun: it has no moves. Any other that ends with an error has failed."""


@dataclass(frozen=True)
class Outcome:
    """The end of a run: why, after how many ticks, and the digest of everything written until then.

    `state` and `reason` are those of the level that ends the run; `faults` are latched faults and lost boards.
    """

    cause: Cause
    ticks: int
    state: str
    reason: str
    digest: str
    faults: tuple[str, ...]

    @property
    def worked(self) -> bool:
        """Whether the run served its purpose: no fault, and no task was refused, failed or cut short."""
        return not self.faults and self.cause in ("task done", "time over")


class Journal:
    """Keeps `events`, and calls `on_event` with each. Without a `segment` there is no tick."""

    def __init__(self, on_event: Callable[[Event], None] | None) -> None:
        self.events: list[Event] = []
        self.segment: Segment | None = None
        self._on_event = on_event

    def add(
        self,
        kind: EventKind,
        board: str,
        text: str,
        code: str = "",
        at_ns: int | None = None,
        tick: int | None = None,
        subject: str = "",
    ) -> None:
        """Record an event that happens now, or that happened at CLOCK_MONOTONIC `at_ns` and `tick`."""
        now_ns = time.time_ns()
        stamp_ns = now_ns if at_ns is None else now_ns - time.monotonic_ns() + at_ns
        self.keep(Event(stamp_ns, self._tick if tick is None else tick, kind, board, text, code, subject=subject))

    def keep(self, event: Event) -> None:
        """Record an event, and pass it on."""
        self.events.append(event)
        if self._on_event:
            self._on_event(event)

    @property
    def _tick(self) -> int:
        if self.segment is None or self.segment.words[System.STATE] == Run.STARTING:
            return -1
        return self.segment.words[System.TICK]
