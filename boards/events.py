"""The record of a run: its events as they happen, and its end."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.message import State
from rack.backplane.segment import Segment
from rack.backplane.words import Run, System

OfRun = Literal["launch", "waiting", "ready", "start", "printed", "died", "done", "stop", "end", "recorder", "command"]
OfFaults = Literal["fault", "detection", "miss", "reaction", "recovery", "held"]
EventKind = OfRun | OfFaults


@dataclass(frozen=True)
class Event:
    """An occurrence in a run. `time_ns` is CLOCK_REALTIME; `tick` is the system clock's (-1: before the run).

    For programs: `code` is an alarm's name in lower case, "begins" or "ends" for a fault, or an operator's command;
    `fault` is an entry of the fault table (-1: none); `subject` is the affected mailbox, joint, task or level; `value`
    is the measured value, or a command's serial; `since` is the tick at which the condition began (-1: unknown).
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
"""A task is refused if it never began, as it has no moves; any other task that ends with an error has failed."""


@dataclass(frozen=True)
class Outcome:
    """The end of a run: its cause, its length in ticks, and the digest of everything written until then.

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
        """Whether the run succeeded: no fault, and no task was refused, failed or cut short."""
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
        """Record an event that happens now, or happened at CLOCK_MONOTONIC `at_ns` and `tick`."""
        now_ns = time.time_ns()
        stamp_ns = now_ns if at_ns is None else now_ns - time.monotonic_ns() + at_ns
        self.keep(Event(stamp_ns, self._tick if tick is None else tick, kind, board, text, code, subject=subject))

    def keep(self, event: Event) -> None:
        """Record an event and pass it on."""
        self.events.append(event)
        if self._on_event:
            self._on_event(event)

    @property
    def _tick(self) -> int:
        if self.segment is None or self.segment.words[System.STATE] == Run.STARTING:
            return -1
        return self.segment.words[System.TICK]


class Ending:
    """Judges the end of a run. `ends_run` and `silent` are as in `ClockWiring`."""

    def __init__(self, segment: Segment, ends_run: str | None, silent: int) -> None:
        self._segment, self._ends_run, self._silent = segment, ends_run, silent
        self._observer = None if ends_run is None else open_observer(segment, ends_run)

    def final_state(self) -> tuple[str, str]:
        """Return the last state of the level that ends the run, and the reason."""
        if self._observer is None:
            return "", ""
        status = self._observer.peek().value
        silent_s = self._silence() * self._segment.layout.clock_ns * 1e-9
        reason = f"'{self._ends_run}' has not been written for {silent_s:g} s" if silent_s else status.reason
        return State(status.state).name.lower(), reason

    def latched(self) -> list[str]:
        """Return a line for every level whose last status reports an error, except the level that ends the run."""
        found = []
        for box in self._segment.layout.mailboxes:
            board, _, port = box.name.partition(".")
            if port != "status" or box.name == self._ends_run or "error" not in (field.name for field in box.fields):
                continue
            status = open_observer(self._segment, box.name).peek()
            if status.is_there and status.value.error:
                found.append(f"level '{board}': {status.value.reason}")
        return found

    def cause(self) -> Cause:
        """Return the cause of the end of a run that was not stopped."""
        if self._observer is None or self._ends_run is None:
            return "time over"
        status, fields = self._observer.peek().value, self._segment.layout.mailbox(self._ends_run).fields
        if status.state != State.ERROR and not self._silence():
            return "task done" if status.state == State.DONE else "time over"
        # The field `moves` of a status counts the moves of its program: none if it was refused.
        counts_moves = any(field.name == "moves" and not field.shape for field in fields)
        is_refused = counts_moves and not status.moves
        return "task refused" if is_refused else "task failed"

    def _silence(self) -> int:
        """Return the ticks since the last status of the level that ends the run; 0 if permitted, or if it has ended."""
        assert self._observer is not None, "some level ends the run"
        reading = self._observer.peek()
        if reading.value.state in (State.DONE, State.ERROR):
            return 0
        ticks = self._segment.words[System.TICK] - (self._observer.newest if reading.is_there else 0)
        return ticks if ticks > self._silent else 0
