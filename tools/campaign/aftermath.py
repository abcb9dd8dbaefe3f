"""What was done about a fault, and when all of it was undone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from rack.backplane.watch.alarms import Alarm
from rack.boards.events import Event
from rack.boards.faults.consequences import consequence
from rack.boards.faults.kinds import KINDS, NUMBERS, Where
from rack.tools.campaign.detection import table_kind
from rack.tools.campaign.ending import Strike

BRAKES = "brakes_closed"
LATCHED = "latched"
"""Code of the reaction to a fault that has lasted too long: the brakes stay engaged, and the task ends."""
COLLISION = Alarm.COLLISION.name.lower()
"""Code of the detection to which brakes in the same tick are a reaction, and to no fault."""
UNDONE_BY: Mapping[str, str] = {BRAKES: "brakes_opened", "demand": "demand", "restart": "rejoined"}
"""Reactions, and the recovery that undoes each."""
TAKE_CYCLES: tuple[Where, ...] = ("process", "load", "core", "lock", "clock")
"""Where faults strike that keep boards from their cycles."""


class Aftermath(NamedTuple):
    """Reactions by code, whether all of them were undone, and the ticks from the strike to the last undone.

    `lacking`: codes of reactions that must come after a fault of this kind, and did not; brakes that were engaged
    when it struck cannot be engaged again.
    """

    reactions: tuple[str, ...] = ()
    is_undone: bool = True
    recovery: int | None = None
    lacking: tuple[str, ...] = ()


def aftermath(strike: Strike, events: Sequence[Event], horizon: int) -> Aftermath:
    """Return what came of a fault; reactions from tick `horizon` on are not to it."""
    if strike.tick < 0:
        return Aftermath()
    after = [event for event in events if event.tick >= strike.tick]
    struck = {e.tick for e in after if e.code == COLLISION}
    to_fault = (e for e in after if e.kind == "reaction" and not (e.code == BRAKES and e.tick in struck))
    reactions = [e for e in to_fault if e.tick < horizon and _can_react(strike, e)]
    undone = [_undone(reaction, after) for reaction in reactions]
    names = tuple(dict.fromkeys(event.code for event in reactions))
    required = consequence(table_kind(strike.kind)).reactions
    lacking = tuple(c for c in required if c not in names and not (c == BRAKES and _are_engaged(strike.tick, events)))
    last = max((tick for tick in undone if tick is not None), default=None)
    if None in undone or last is None:
        return Aftermath(names, None not in undone, None, lacking)
    return Aftermath(names, True, last - strike.tick, lacking)


def _can_react(strike: Strike, reaction: Event) -> bool:
    """Say whether a reaction can be to a fault: brakes that close for missed cycles are to one that takes cycles.

    What is latched is a fault of a kind that may be.
    """
    if reaction.code == LATCHED:
        return consequence(table_kind(strike.kind)).latches
    for_misses = reaction.code == BRAKES and reaction.value > 0
    return not for_misses or takes_cycles(strike)


def takes_cycles(strike: Strike) -> bool:
    """Say whether a fault keeps tasks from their cycles, so that these are missed because of it."""
    return KINDS[NUMBERS[table_kind(strike.kind)]].where in TAKE_CYCLES


def _are_engaged(tick: int, events: Sequence[Event]) -> bool:
    """Say whether the brakes were engaged before a tick, and are released after it."""
    before = [e for e in events if e.kind == "reaction" and e.code == BRAKES and e.tick < tick]
    undone = (_undone(event, events) for event in before)
    return any(released is None or released > tick for released in undone)


def _undone(reaction: Event, after: Sequence[Event]) -> int | None:
    """Return the tick at which a reaction was undone; None when it was not."""
    if reaction.code == BRAKES and reaction.value > 0:
        # They were closed for the cycles without torque, which are told of when there is torque again.
        return reaction.tick
    code, board = UNDONE_BY.get(reaction.code), reaction.board if reaction.code == "restart" else None
    later = (e for e in after if e.kind == "recovery" and e.code == code and e.tick >= reaction.tick)
    return min((event.tick for event in later if board in (None, event.board)), default=None)
