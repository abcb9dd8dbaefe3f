"""Which events are the detection of which fault."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from backplane.alarms import Alarm
from boards.events import Event
from boards.faults.kinds import KINDS, NUMBERS
from tools.campaign.ending import Strike
from tools.campaign.plan import EXTERNAL

FOUND = ("detection", "miss", "died")
"""Kinds of events that can be a detection."""
DEATHS = ("kill", EXTERNAL, "lock-held")
"""Kinds that end a process: the Rack sees it, besides its neighbours."""
MAILBOX_ALARMS = {alarm.name.lower() for alarm in Alarm if Alarm.STALE <= alarm <= Alarm.LOCKED}
TASK_ALARMS = {alarm.name.lower() for alarm in (Alarm.HANG, Alarm.LATE, Alarm.PLAN_LATE, Alarm.STARVED)}


@dataclass(frozen=True)
class Detection:
    """An event that tells of a fault: how long after it struck, and what was permitted (None: no bound).

    `delay` and `bound` are ticks; ticks that the clock itself left out did not happen and are not counted.
    `delay_ms` is time of the wall clock, None where that means nothing: in lockstep. `bound_ms` is the bound of a death
    at the Rack; beyond that there is still the one of the neighbours, in ticks, for the loss stands on the backplane as
    soon as the Rack's crate has seen it.
    """

    event: Event
    delay: int
    bound: int | None
    delay_ms: float | None = None
    bound_ms: float | None = None

    @property
    def is_within(self) -> bool:
        """Whether the fault was found as soon as it must be."""
        if self.bound_ms is not None and self.delay_ms is not None and self.delay_ms <= self.bound_ms:
            return True
        return self.bound is None or self.delay <= self.bound

    @property
    def order(self) -> tuple[bool, int, float]:
        """What tells the best of several detections: one within its bound, then the first."""
        return not self.is_within, self.delay, self.delay_ms or 0.0


def codes_of(kind: str) -> set[str]:
    """Return the codes of events that count as detection of a kind."""
    kill = kind == EXTERNAL
    codes = {alarm.name.lower() for alarm in KINDS[NUMBERS["kill" if kill else kind]].seen_as}
    return codes | ({"died"} if kind in DEATHS else set())


def fits(event: Event, strike: Strike) -> bool:
    """Say whether an event can be of a fault: it is of its kind, about the same thing, and not before it.

    A fault may strike a moment before its tick is given out; who looks at the tick then sees the one before.
    """
    if event.kind not in FOUND or strike.tick < 0 or event.tick < strike.tick - (event.kind == "died"):
        return False
    code = "died" if event.kind == "died" else event.code
    if code not in codes_of(strike.kind):
        return False
    if code == "died":
        return event.board == strike.board
    if code in MAILBOX_ALARMS:
        return event.subject in strike.mailboxes
    if code in TASK_ALARMS:
        return event.subject == strike.board
    # What is said of all joints may be said of any, and the other way round.
    return not event.subject or not strike.joint or event.subject == strike.joint


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
