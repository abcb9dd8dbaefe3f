"""The record of a run: its events as they happen, and its end."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.message import AnyMessage, State, reason_of, state_name
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, System

if TYPE_CHECKING:
    from rack.levels.tables import GoalConfig

OfRun = Literal[
    "launch",
    "waiting",
    "ready",
    "start",
    "printed",
    "died",
    "done",
    "stop",
    "end",
    "recorder",
    "command",
]
OfFaults = Literal["fault", "detection", "miss", "reaction", "recovery", "held"]
EventKind = OfRun | OfFaults
CONTINUES = "continues"
"""Code of the event that says before which tick a run begins that goes on from another."""


@dataclass(frozen=True)
class Event:
    """An occurrence in a run. `time_ns` is CLOCK_REALTIME; `tick` is the system clock's (-1: before
    the run).

    For programs: `code` is an alarm's name in lower case, "begins" or "ends" for a fault, or an
    operator's command; `fault` is an entry of the fault table (-1: none); `subject` is the affected
    mailbox, joint, task or level; `value` is the measured value, or a command's serial; `since` is
    the tick at which the condition began (-1: unknown).
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


DEMANDED = "a stop is demanded"
NO_TORQUE = "no torque"
"""Reasons for which brakes engage: on a demand, of which other events say why, or because no torque
came in time."""
HELD_MS = 5e3
"""Time on end for which an arm may be braked, or a level held, in a run that succeeds, without a
cause in sight."""
HELD_PART = 0.5
"""Part of a run for which an arm may be braked so, again and again."""


@dataclass(frozen=True)
class Braking:
    """Brakes that engaged for one reason at tick `since`."""

    why: str
    since: int
    lasted_ms: float


def brakings(events: Sequence[Event], end: int, tick_ms: float) -> tuple[Braking, ...]:
    """Return every time that brakes engaged in a run of `end` ticks, by its events; not those of
    the start.
    """
    changes = [event for event in events if event.code in ("brakes_closed", "brakes_opened")]
    found = [
        (one.subject, one.tick - int(one.value), one.tick)
        for one in changes
        if one.code == "brakes_opened"
    ]
    if changes and changes[-1].code == "brakes_closed":
        found.append((changes[-1].subject, changes[-1].tick, end))
    return tuple(
        Braking(why, since, round((until - since) * tick_ms, 6))
        for why, since, until in found
        if why
    )


def braked_text(found: Sequence[Braking]) -> str:
    """Return how often brakes engaged, at least once, how long, and why, as readable text."""
    longest = max(found, key=lambda one: one.lasted_ms)
    total_ms = sum(one.lasted_ms for one in found)
    times = f"{total_ms:g} ms in all, longest {longest.lasted_ms:g} ms at tick {longest.since}"
    reasons = ", ".join(
        f"{why} ({count})" for why, count in Counter(one.why for one in found).most_common()
    )
    return f"brakes engaged {len(found)} time{'s' * (len(found) > 1)}, {times}: {reasons}"


Cause = Literal[
    "task done",
    "task refused",
    "task failed",
    "time over",
    "stopped",
    "board lost",
    "launcher lost",
]
"""A task is refused if it never began, as it has no moves; any other task that ends with an error
has failed."""
SUCCESSES: tuple[Cause, ...] = ("task done", "time over")
"""Causes of a run that may have succeeded."""


@dataclass(frozen=True)
class Outcome:
    """The end of a run: its cause, its length in ticks, and the digest of everything written until
    then.

    `state` and `reason` are those of the level that ends the run; `faults` are latched faults, lost
    boards, objects beyond their goals when the task says that it is done, long holds without a
    cause in sight, and levels that lost too many cycles. `brakings` are those after the start;
    `objects`: where each ended; `excused`: a line for each level that lost too many cycles because
    of injected faults.
    """

    cause: Cause
    ticks: int
    state: str
    reason: str
    digest: str
    faults: tuple[str, ...]
    brakings: tuple[Braking, ...] = ()
    objects: tuple[ObjectEnd, ...] = ()
    excused: tuple[str, ...] = ()

    @property
    def failure(self) -> str:
        """Why the run failed: a fault, or a task that was refused, failed or cut short; empty if it
        succeeded.
        """
        faults = "; ".join(self.faults)
        if self.cause in SUCCESSES:
            return faults
        return f"{self.cause}: {faults or self.reason or f'after {self.ticks} ticks'}"

    @property
    def worked(self) -> bool:
        """Whether the run succeeded."""
        return not self.failure


def order_key(entry: Mapping[str, Any]) -> float:
    """Return the place of an entry in an event log: its tick.

    Some events are known late: a board that drives an arm tells, once it is back, when the brakes
    engaged. Entries without a tick, such as the outcome, come last.
    """
    return float(entry.get("tick", math.inf))


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
        if tick is None:
            tick = self._tick
        self.keep(Event(stamp_ns, tick, kind, board, text, code, subject=subject))

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


def statuses(segment: Segment, field: str) -> Iterator[tuple[str, AnyMessage]]:
    """Yield the last status of every level whose status has a field, with its board."""
    for box in segment.layout.mailboxes:
        if box.name.endswith(".status") and field in (own.name for own in box.fields):
            status = open_observer(segment, box.name).peek()
            if status.is_there:
                yield box.writer, status.message


def arm_states(segment: Segment) -> Iterator[tuple[str, AnyMessage]]:
    """Yield the last state of every arm or hand, which it counts by itself, with its board."""
    for box in segment.layout.mailboxes:
        if box.message == "arm_state":
            yield box.writer, open_observer(segment, box.name).peek().message


class Ending:
    """Judges the end of a run. `ends_run` and `silent` are as in `ClockWiring`."""

    def __init__(self, segment: Segment, ends_run: str | None, silent: int) -> None:
        self._segment = segment
        self._ends_run = ends_run
        self._silent = silent
        self._observer = None if ends_run is None else open_observer(segment, ends_run)

    def final_state(self) -> tuple[str, str]:
        """Return the last state of the level that ends the run, and the reason."""
        if self._observer is None:
            return "", ""
        status = self._observer.peek().message
        silent_s = self._silence() * self._segment.layout.clock_ns * 1e-9
        reason = (
            f"'{self._ends_run}' has not been written for {silent_s:g} s"
            if silent_s
            else reason_of(status)
        )
        return state_name(status.state), reason

    def latched(self) -> list[str]:
        """Return a line for every level whose last status reports an error, except the level that
        ends the run; and for every arm that counts what its level does not report.
        """
        told = {
            board: f"level '{board}': {reason_of(status) or f'error {status.error}'}"
            for board, status in statuses(self._segment, "error")
            if status.error and f"{board}.status" != self._ends_run
        }
        counted = {
            board: f"arm of '{board}': limits exceeded in {state.violations} substeps,"
            f" {state.touches} unintended contacts"
            for board, state in arm_states(self._segment)
            if state.violations or state.touches
        }
        return [*(counted | told).values()]

    def held(
        self, events: Sequence[Event], found: Sequence[Braking], ran_ms: float
    ) -> Iterator[str]:
        """Yield in a line what held a run of `ran_ms` for so long that it is no success.

        Nothing is yielded with a cause in sight: a fault was injected, an operator has commanded, a
        stop is demanded. Levels of a rack on a network wait for other racks, and show for which.
        """
        segment = self._segment
        if segment.words[System.DEMAND] or any(
            event.kind in ("fault", "command") for event in events
        ):
            return
        tick_ms = segment.layout.clock_ns * 1e-6
        hands = dict(statuses(segment, "tension"))
        braked = {
            name: message
            for name, message in (*arm_states(segment), *statuses(segment, "braked"))
            if message.braked and name not in hands and not found
        }
        never = []
        for name, message in braked.items():
            since = segment.block(name)[Block.LEVEL_SINCE]
            why = reason_of(message) or NO_TORQUE
            never.append(Braking(why, since, ran_ms - since * tick_ms))
        held = []
        for name, status in statuses(segment, "state"):
            block = segment.block(name)
            lasted_ms = ran_ms - block[Block.LEVEL_SINCE] * tick_ms
            if block[Block.LEVEL_STATE] == State.HOLDING and lasted_ms > HELD_MS:
                held.append(
                    f"level '{name}' held for {lasted_ms:g} ms without a cause in sight:"
                    f" {reason_of(status) or 'no reason given'}"
                )
        counted = [one for one in found if one.why != DEMANDED] or never
        times = [one.lasted_ms for one in counted]
        if max(times, default=0.0) > HELD_MS or sum(times) > HELD_PART * ran_ms:
            yield f"held without a cause in sight, in {ran_ms:g} ms: {braked_text(counted)}"
        elif not any(box.name.startswith("lan.") for box in segment.layout.mailboxes):
            yield from held

    def ends(self, goals: Mapping[int, GoalConfig]) -> tuple[ObjectEnd, ...]:
        """Return where objects that have goals ended, as sensed last; none if nothing senses
        them.
        """
        for box in self._segment.layout.mailboxes:
            if (
                box.message == "scene"
                and (scene := open_observer(self._segment, box.name).peek()).is_there
            ):
                rows = scene.message.position
                return tuple(ObjectEnd.of(goal, rows[row].tolist()) for row, goal in goals.items())
        return ()

    def cause(self) -> Cause:
        """Return the cause of the end of a run that was not stopped."""
        if self._observer is None or self._ends_run is None:
            return "time over"
        status = self._observer.peek().message
        fields = self._segment.layout.mailbox(self._ends_run).fields
        if status.state != State.ERROR and not self._silence():
            return "task done" if status.state == State.DONE else "time over"
        # The field `moves` of a status counts the moves of its program: none if it was refused.
        counts_moves = any(field.name == "moves" and not field.shape for field in fields)
        is_refused = counts_moves and not status.moves
        return "task refused" if is_refused else "task failed"

    def _silence(self) -> int:
        """Return the ticks since the last status of the level that ends the run; 0 if permitted, or
        if it has ended.
        """
        assert self._observer is not None, "some level ends the run"
        reading = self._observer.peek()
        if reading.message.state in (State.DONE, State.ERROR):
            return 0
        newest = self._observer.newest if reading.is_there else 0
        ticks = self._segment.words[System.TICK] - newest
        return ticks if ticks > self._silent else 0


@dataclass(frozen=True)
class ObjectEnd:
    """The goal of an object, and where it ended, m."""

    object: str
    goal: Sequence[float]
    ended: Sequence[float]
    off_mm: float
    tolerance_mm: float

    @classmethod
    def of(cls, goal: GoalConfig, ended: Sequence[float]) -> Self:
        """Return the end of the object that has a goal, m."""
        off_mm = round(1e3 * math.dist(ended, goal.position), 3)
        return cls(goal.object, goal.position, ended, off_mm, goal.tolerance_mm)

    def __str__(self) -> str:
        return (
            f"object '{self.object}' ended {self.off_mm:.0f} mm from its goal (tolerance"
            f" {self.tolerance_mm:g} mm)"
        )
