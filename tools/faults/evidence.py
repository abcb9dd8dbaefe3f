"""Events as evidence of faults: which event can be the detection of which fault, and the reactions
to it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from rack.backplane.address_map import CLOCK
from rack.backplane.watch.alarms import Alarm
from rack.boards.events import Event
from rack.boards.faults.describe import ALL_JOINTS
from rack.boards.faults.kind import DIED, Where
from rack.tools.faults.ending import Strike


def _codes(alarms: Iterable[Alarm]) -> set[str]:
    return {alarm.name.lower() for alarm in alarms}


FOUND = ("detection", "miss", DIED)
"""Kinds of events that can be a detection."""
MAILBOX_ALARMS = _codes(alarm for alarm in Alarm if Alarm.STALE <= alarm <= Alarm.QUEUE_FULL)
CLOCK_ALARMS = _codes(alarm for alarm in Alarm if Alarm.CLOCK_STOPPED <= alarm <= Alarm.CLOCK_LATE)
TASK_ALARMS = _codes((Alarm.HANG, Alarm.LATE, Alarm.PLAN_LATE, Alarm.STARVED))
BRAKES = "brakes_closed"
LATCHED = "latched"
"""Code of the reaction to a fault that has lasted too long: the brakes stay engaged, and the task
ends."""
COLLISION = Alarm.COLLISION.name.lower()
"""Code of the detection to which brakes in the same tick are a reaction; they are none to a fault
then."""
UNDONE_BY: Mapping[str, str] = {BRAKES: "brakes_opened", "demand": "demand", "restart": "rejoined"}
"""Reactions, and the recovery that undoes each."""
TAKE_CYCLES: tuple[Where, ...] = ("process", "load", "core", "lock", "clock")
"""Places of faults that keep boards from their cycles."""


@dataclass(frozen=True)
class Detection:
    """An event that reports a fault: how long after it struck, and the time permitted (None: no
    bound).

    `delay` and `bound` are ticks; ticks that the clock itself skipped did not happen and are not
    counted. `delay_ms` is wall-clock time, None in lockstep, where it means nothing. `bound_ms` is
    the bound of a death in real time, and then the only one.
    """

    event: Event
    delay: int
    bound: int | None
    delay_ms: float | None = None
    bound_ms: float | None = None

    @property
    def is_within(self) -> bool:
        """Whether the fault was found within its bound."""
        if self.bound_ms is not None and self.delay_ms is not None:
            return self.delay_ms <= self.bound_ms
        return self.bound is None or self.delay <= self.bound

    @property
    def order(self) -> tuple[bool, int, float, float, str]:
        """Key by which the best of several detections comes first: one within its bound, then the
        earliest, then that of the tightest bound, then by board.

        In lockstep boards find a fault in the same tick, in an order that is chance.
        """
        bound = math.inf if self.bound is None else self.bound
        return not self.is_within, self.delay, self.delay_ms or 0.0, bound, self.event.board


def fits(event: Event, strike: Strike) -> bool:
    """Return whether an event can be the detection of a fault: of its kind, about the same thing,
    and not before it.

    A fault may strike a moment before its tick is given out; a process that reads the tick then
    sees the one before.
    """
    return (
        event.kind in FOUND
        and 0 <= strike.tick <= event.tick + (event.kind == DIED)
        and event.code in strike.record.codes
        and is_about(event, strike)
    )


def explains(strike: Strike, event: Event) -> bool:
    """Return whether an event in a fault's time can come of it: as its detection, or as a
    consequence of its kind.
    """
    follows = strike.record.consequence
    if event.kind == "miss":
        # A fault that takes one task's cycles may take those of any task on its core.
        return takes_cycles(strike)
    if event.kind == DIED:
        return strike.board == event.board and follows.ends_process
    if event.code in _codes(follows.arm):
        return True
    return event.code in _codes(follows.own).union(strike.record.codes) and is_about(event, strike)


def is_about(event: Event, strike: Strike) -> bool:
    """Return whether an event is about the target of a fault: its mailboxes, its task, its
    joint.
    """
    if event.code == DIED:
        return event.board == strike.board
    if event.code in MAILBOX_ALARMS:
        return event.subject in strike.mailboxes
    if event.code in TASK_ALARMS:
        return event.subject == strike.board
    if event.code in CLOCK_ALARMS:
        return strike.board == CLOCK
    # An alarm about all joints may be about any, and the other way round.
    return not event.subject or not strike.joint or event.subject in (strike.joint, ALL_JOINTS)


class SkippedTicks:
    """The ticks that the clock skipped in a run."""

    def __init__(self, events: Sequence[Event]) -> None:
        name = Alarm.CLOCK_SKIPPED.name.lower()
        self._skips = [event for event in events if event.kind == "miss" and event.code == name]

    def between(self, first: int, last: int) -> int:
        """Return how many ticks after `first`, up to `last`, did not happen: as many as any one
        task has missed.
        """
        by_task = Counter[str]()
        for event in self._skips:
            if first < event.tick <= last:
                by_task[event.board] += int(event.value)
        return min(max(by_task.values(), default=0), max(0, last - first))


class Aftermath(NamedTuple):
    """Reactions by code, whether all of them were undone, and the ticks from the strike to the last
    undone.

    Lost messages are undone when a good one, made after the fault, was seen in each mailbox that
    owes one. `lacking`: codes of reactions that must follow a fault of this kind, and did not;
    brakes that were engaged when it struck cannot be engaged again.
    """

    reactions: tuple[str, ...] = ()
    is_undone: bool = True
    recovery: int | None = None
    lacking: tuple[str, ...] = ()


def aftermath(
    strike: Strike, events: Sequence[Event], horizon: int, owed: Sequence[str]
) -> Aftermath:
    """Return the reactions to a fault and their end; reactions from tick `horizon` on are not to
    it.

    `owed`: mailboxes that must have a new message after it.
    """
    if strike.tick < 0:
        return Aftermath()
    after = [event for event in events if event.tick >= strike.tick]
    collisions = {event.tick for event in after if event.code == COLLISION}
    reactions = [
        event
        for event in after
        if event.kind == "reaction"
        and event.tick < horizon
        and not (event.code == BRAKES and event.tick in collisions)
        and _can_react(strike, event)
    ]
    undone = [_undone(reaction, after) for reaction in reactions]
    flows = {
        e.subject: e.tick for e in reversed(after) if e.code == "flows" and e.tick >= strike.ends
    }
    undone += [flows.get(mailbox) for mailbox in owed]
    names = tuple(dict.fromkeys(event.code for event in reactions))
    lacking = tuple(
        code
        for code in strike.record.consequence.reactions
        if code not in names and not (code == BRAKES and _are_engaged(strike.tick, events))
    )
    ticks = [tick for tick in undone if tick is not None]
    is_undone = len(ticks) == len(undone)
    recovery = max(ticks) - strike.tick if ticks and is_undone else None
    return Aftermath(names, is_undone, recovery, lacking)


def _can_react(strike: Strike, reaction: Event) -> bool:
    """Return whether a reaction can be to a fault: brakes that engage for missed cycles are to one
    that takes cycles.

    A latch is a reaction to a kind that may be latched.
    """
    if reaction.code == LATCHED:
        return strike.record.consequence.latches
    for_misses = reaction.code == BRAKES and reaction.value > 0
    return not for_misses or takes_cycles(strike)


def takes_cycles(strike: Strike) -> bool:
    """Return whether a fault keeps tasks from their cycles, so that these are missed because of
    it.
    """
    return strike.record.where in TAKE_CYCLES


def _are_engaged(tick: int, events: Sequence[Event]) -> bool:
    """Return whether the brakes were engaged before a tick, and are released after it."""
    before = [e for e in events if e.kind == "reaction" and e.code == BRAKES and e.tick < tick]
    undone = (_undone(event, events) for event in before)
    return any(released is None or released > tick for released in undone)


def _undone(reaction: Event, after: Sequence[Event]) -> int | None:
    """Return the tick at which a reaction was undone; None when it was not."""
    recoveries = (
        event.tick
        for event in after
        if event.kind == "recovery"
        and event.code == UNDONE_BY.get(reaction.code)
        and event.tick >= reaction.tick
        and (reaction.code != "restart" or event.board == reaction.board)
    )
    return min(recoveries, default=None)
