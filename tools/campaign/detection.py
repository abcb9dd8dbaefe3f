"""Which events are the detection of which fault."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rack.backplane.address_map import CLOCK
from rack.backplane.watch.alarms import Alarm
from rack.boards.events import Event
from rack.boards.faults.consequences import consequence
from rack.boards.faults.kinds import KINDS, NUMBERS
from rack.boards.faults.text import ALL_JOINTS
from rack.tools.campaign.ending import Strike
from rack.tools.campaign.plan import EXTERNAL

FOUND = ("detection", "miss", "died")
"""Kinds of events that can be a detection."""
MAILBOX_ALARMS = {alarm.name.lower() for alarm in Alarm if Alarm.STALE <= alarm <= Alarm.LOCKED}
CLOCK_ALARMS = {alarm.name.lower() for alarm in Alarm if Alarm.CLOCK_STOPPED <= alarm <= Alarm.CLOCK_LATE}
TASK_ALARMS = {alarm.name.lower() for alarm in (Alarm.HANG, Alarm.LATE, Alarm.PLAN_LATE, Alarm.STARVED)}


@dataclass(frozen=True)
class Detection:
    """An event that tells of a fault: how long after it struck, and what was permitted (None: no bound).

    `delay` and `bound` are ticks; ticks that the clock itself left out did not happen and are not counted.
    `delay_ms` is time of the wall clock, None where that means nothing: in lockstep. `bound_ms` is the bound of a death
    in real time, and then the only one.
    """

    event: Event
    delay: int
    bound: int | None
    delay_ms: float | None = None
    bound_ms: float | None = None

    @property
    def is_within(self) -> bool:
        """Whether the fault was found as soon as it must be."""
        if self.bound_ms is not None and self.delay_ms is not None:
            return self.delay_ms <= self.bound_ms
        return self.bound is None or self.delay <= self.bound

    @property
    def order(self) -> tuple[bool, int, float]:
        """What tells the best of several detections: one within its bound, then the first."""
        return not self.is_within, self.delay, self.delay_ms or 0.0


def table_kind(kind: str) -> str:
    """Return the kind of the table of kinds that a kind of a campaign behaves as."""
    return "kill" if kind == EXTERNAL else kind


def codes_of(kind: str) -> set[str]:
    """Return the codes of events that count as detection of a kind: a death is the Rack's to find."""
    if table_kind(kind) == "kill":
        return {"died"}
    return {alarm.name.lower() for alarm in KINDS[NUMBERS[kind]].seen_as} | ({"died"} if kind == "lock-held" else set())


def fits(event: Event, strike: Strike) -> bool:
    """Say whether an event can be the detection of a fault: it is of its kind, about the same thing, and not before it.

    A fault may strike a moment before its tick is given out; who looks at the tick then sees the one before.
    """
    if event.kind not in FOUND or strike.tick < 0 or event.tick < strike.tick - (event.kind == "died"):
        return False
    return event.code in codes_of(strike.kind) and is_about(event, strike)


def explains(strike: Strike, event: Event) -> bool:
    """Say whether an event in a fault's time can come of it: as its detection, or as a consequence of its kind."""
    follows = consequence(table_kind(strike.kind))
    if event.kind == "died":
        return strike.board == event.board and follows.ends_process
    if event.code in {alarm.name.lower() for alarm in follows.arm}:
        return True
    own = {alarm.name.lower() for alarm in (*KINDS[NUMBERS[table_kind(strike.kind)]].seen_as, *follows.own)}
    return event.code in own and is_about(event, strike)


def is_about(event: Event, strike: Strike) -> bool:
    """Say whether an event is about what a fault has struck: its mailboxes, its task, its joint."""
    if event.code == "died":
        return event.board == strike.board
    if event.code in MAILBOX_ALARMS:
        return event.subject in strike.mailboxes
    if event.code in TASK_ALARMS:
        return event.subject == strike.board
    if event.code in CLOCK_ALARMS:
        return strike.board == CLOCK
    # An alarm about all joints may be about any, and the other way round.
    return not event.subject or not strike.joint or event.subject in (strike.joint, ALL_JOINTS)


class LeftOut:
    """The ticks that the clock left out in a run."""

    def __init__(self, events: Sequence[Event]) -> None:
        name = Alarm.CLOCK_SKIPPED.name.lower()
        self._skips: dict[str, list[tuple[int, int]]] = {}
        for event in events:
            if event.kind == "miss" and event.code == name:
                self._skips.setdefault(event.board, []).append((event.tick, int(event.value)))

    def between(self, first: int, last: int) -> int:
        """Return how many ticks after `first`, up to `last`, did not happen: as many as any one task has missed."""
        sums = (sum(count for tick, count in skips if first < tick <= last) for skips in self._skips.values())
        return min(max(sums, default=0), max(0, last - first))


def candidates(events: Sequence[Event], strike: Strike, until: int) -> Iterator[Event]:
    """Yield the events up to tick `until` that can be of a fault."""
    return (event for event in events if event.tick <= until and fits(event, strike))
