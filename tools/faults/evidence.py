"""Events as evidence of faults: possible detections of a fault, and reactions to it."""

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


def _to_codes(alarms: Iterable[Alarm]) -> set[str]:
    """Return the event codes of alarms."""
    return {alarm.name.lower() for alarm in alarms}


DETECTION_KINDS = ("detection", "miss", DIED)
"""Kinds of events that can count as detections."""
DIFFERS = Alarm.DIFFERS.name.lower()
MAILBOX_ALARMS = _to_codes(alarm for alarm in Alarm if Alarm.STALE <= alarm <= Alarm.QUEUE_FULL)
CLOCK_ALARMS = _to_codes(
    alarm for alarm in Alarm if Alarm.CLOCK_STOPPED <= alarm <= Alarm.CLOCK_LATE
)
TASK_ALARMS = _to_codes((Alarm.STRAYED, Alarm.HANG, Alarm.LATE, Alarm.PLAN_LATE, Alarm.STARVED))
BRAKES = "brakes_closed"
LATCHED = "latched"
"""Code of the reaction to a fault that lasted too long: brakes stay closed and the task ends."""
COLLISION = Alarm.COLLISION.name.lower()
"""Code of a collision. Brakes that close in the same tick are a reaction to it."""
SKIPPED = Alarm.CLOCK_SKIPPED.name.lower()
UNDONE_BY: Mapping[str, str] = {BRAKES: "brakes_opened", "demand": "demand", "restart": "rejoined"}
"""Code of the recovery that undoes each reaction."""
TAKE_CYCLES: tuple[Where, ...] = ("process", "load", "core", "lock", "clock")
"""Values of `Kind.where` for faults that may keep boards from running their cycles."""


@dataclass(frozen=True)
class Detection:
    """An event that reports a fault, with its delay and its bound.

    Attributes:
        event: The event.
        delay: Ticks from the fault's first action, without ticks that the clock skipped.
        bound: Largest permitted delay in ticks. None if there is no bound.
        delay_ms: Delay in ms of wall-clock time. None in lockstep, where it is meaningless.
        bound_ms: Bound in ms for a death in real time, which replaces `bound`. None otherwise.
    """

    event: Event
    delay: int
    bound: int | None
    delay_ms: float | None = None
    bound_ms: float | None = None

    @property
    def is_within(self) -> bool:
        """Whether the fault was detected within its bound."""
        if self.bound_ms is not None and self.delay_ms is not None:
            return self.delay_ms <= self.bound_ms
        return self.bound is None or self.delay <= self.bound

    @property
    def sort_key(self) -> tuple[bool, int, float, float, str]:
        """Key for sorting detections so that the best one comes first.

        Detections within their bounds come first, then those with a shorter delay, then those with
        a tighter bound. The name of the board breaks ties, because in lockstep boards may detect a
        fault in the same tick and report it in any order.
        """
        bound = math.inf if self.bound is None else self.bound
        return not self.is_within, self.delay, self.delay_ms or 0.0, bound, self.event.board


def can_be_detection(event: Event, strike: Strike) -> bool:
    """Return True if an event can be the detection of a fault.

    The event must have one of the codes by which the kind of the fault is reported, concern the
    same target, and not precede the fault. A death may precede it by one tick, because a fault may
    act shortly before other processes can read the new tick.
    """
    return (
        event.kind in DETECTION_KINDS
        and 0 <= strike.tick <= event.tick + (event.kind == DIED)
        and event.code in strike.record.codes
        and concerns_target(event, strike)
    )


def can_explain(strike: Strike, event: Event) -> bool:
    """Return True if an event during a fault may be its detection or one of its consequences."""
    consequence = strike.record.consequence
    if event.kind == "miss":
        # A fault that makes one task miss cycles can have this effect on any task of its core.
        return takes_cycles(strike)
    if event.kind == DIED:
        return strike.board == event.board and consequence.ends_process
    if event.code in _to_codes(consequence.arm):
        return True
    return event.code in _to_codes(consequence.own).union(strike.record.codes) and concerns_target(
        event, strike
    )


def concerns_target(event: Event, strike: Strike) -> bool:
    """Return True if an event concerns the target of a fault: its mailboxes, task or joint."""
    if event.code == DIED:
        return event.board == strike.board
    if event.code in MAILBOX_ALARMS or event.code == DIFFERS:
        return event.subject in strike.mailboxes
    if event.code in TASK_ALARMS:
        return event.subject == strike.board
    if event.code in CLOCK_ALARMS:
        return strike.board == CLOCK
    # An alarm about all joints concerns the joint of any fault. A fault of all joints may cause
    # an alarm about any joint.
    return not event.subject or not strike.joint or event.subject in (strike.joint, ALL_JOINTS)


def count_skipped_ticks(events: Iterable[Event], first: int, last: int) -> int:
    """Return the number of ticks that the clock skipped after tick `first`, up to `last`.

    Each task reports only the skips that it notices, so the result is the largest number that any
    one task reported.
    """
    by_task = Counter[str]()
    for event in events:
        if event.kind == "miss" and event.code == SKIPPED and first < event.tick <= last:
            by_task[event.board] += int(event.value)
    return min(max(by_task.values(), default=0), max(0, last - first))


class Aftermath(NamedTuple):
    """Reactions to a fault.

    Attributes:
        reactions: Codes of the reactions.
        is_undone: Whether all reactions were undone and all lost messages replaced. Messages of a
            mailbox count as replaced once it contains a good message from after the fault.
        recovery: Ticks from the fault's first action until the last reaction was undone.
        lacking: Codes of required reactions that did not follow. Brakes that were already closed
            are not required to close.
    """

    reactions: tuple[str, ...] = ()
    is_undone: bool = True
    recovery: int | None = None
    lacking: tuple[str, ...] = ()


def find_aftermath(
    strike: Strike, events: Sequence[Event], horizon: int, owed: Sequence[str]
) -> Aftermath:
    """Find the reactions to a fault and when they were undone.

    Args:
        strike: The fault.
        events: Events of the run.
        horizon: Tick from which reactions no longer belong to the fault.
        owed: Mailboxes in which a new message must appear after the fault.
    """
    if strike.tick < 0:
        return Aftermath()
    events_after = [event for event in events if event.tick >= strike.tick]
    collisions = {event.tick for event in events_after if event.code == COLLISION}
    reactions = [
        event
        for event in events_after
        if event.kind == "reaction"
        and event.tick < horizon
        and not (event.code == BRAKES and event.tick in collisions)
        and _can_react(strike, event)
    ]
    undone_ticks = [_find_undone_tick(reaction, events_after) for reaction in reactions]
    flows = {
        event.subject: event.tick
        for event in reversed(events_after)
        if event.code == "flows" and event.tick >= strike.ends
    }
    undone_ticks += [flows.get(mailbox) for mailbox in owed]
    names = tuple(dict.fromkeys(event.code for event in reactions))
    lacking = tuple(
        code
        for code in strike.record.consequence.reactions
        if code not in names and not (code == BRAKES and _were_brakes_closed(strike.tick, events))
    )
    known_ticks = [tick for tick in undone_ticks if tick is not None]
    is_undone = len(known_ticks) == len(undone_ticks)
    recovery = max(known_ticks) - strike.tick if known_ticks and is_undone else None
    return Aftermath(names, is_undone, recovery, lacking)


def _can_react(strike: Strike, reaction: Event) -> bool:
    """Return True if a reaction may have been caused by a fault.

    If the brakes closed because of missed cycles, the fault must be one for which `takes_cycles`
    is True. If the reaction is a latch, the kind of the fault must permit a latch.
    """
    if reaction.code == LATCHED:
        return strike.record.consequence.latches
    for_misses = reaction.code == BRAKES and reaction.value > 0
    return not for_misses or takes_cycles(strike)


def takes_cycles(strike: Strike) -> bool:
    """Return True if a fault may keep tasks from running their cycles."""
    return strike.record.where in TAKE_CYCLES


def _were_brakes_closed(tick: int, events: Sequence[Event]) -> bool:
    """Return True if the brakes were closed before a tick and opened only after it."""
    brakings = [e for e in events if e.kind == "reaction" and e.code == BRAKES and e.tick < tick]
    undone = (_find_undone_tick(event, events) for event in brakings)
    return any(released is None or released > tick for released in undone)


def _find_undone_tick(reaction: Event, events_after: Sequence[Event]) -> int | None:
    """Return the tick at which a reaction was undone, or None if it was not."""
    recoveries = (
        event.tick
        for event in events_after
        if event.kind == "recovery"
        and event.code == UNDONE_BY.get(reaction.code)
        and event.tick >= reaction.tick
        and (reaction.code != "restart" or event.board == reaction.board)
    )
    return min(recoveries, default=None)
