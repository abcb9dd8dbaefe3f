"""A rack that is paused, and goes on: in lockstep between two ticks, in real time by the operator's
hold."""

from __future__ import annotations

from typing import NamedTuple

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.tools.console.answer import Failure
from rack.tools.live.desk import LiveDesk
from rack.tools.live.stepper import Stepper


class Pause(NamedTuple):
    """A pause: before `tick` in lockstep, otherwise from it on, with the `levels` held for it."""

    tick: int
    levels: list[str]


def pause(segment: Segment) -> Pause:
    """Pause a rack, and return when it is held, or its arm at rest.

    Raises `Failure` where no level is above all others that take a hold, or it is refused.
    """
    if segment.words[System.LOCKSTEP]:
        return Pause(Stepper(segment).hold(), [])
    desk = LiveDesk(segment)
    levels = desk.highest("", "hold")
    if len(levels) != 1:
        found = ", ".join(levels) or "none"
        needed = "of the levels that take a hold one must be above all others"
        raise Failure(f"rack '{segment.rack}' runs in real time: {needed}; highest: {found}")
    reply = desk.give({"level": levels[0], "what": "hold"}, wait=True)
    if reply.fate != "done":
        raise Failure(reply.line)
    return Pause(reply.done, levels)


def resume(segment: Segment) -> list[str]:
    """Let a paused rack go on; return the levels that were held. Raises `Failure` when it is not
    paused."""
    words = segment.words
    levels: list[str] = []
    if words[System.LOCKSTEP]:
        is_paused = words[System.HOLD_AT] > 0
        Stepper(segment).let_go()
    else:
        desk = LiveDesk(segment)
        levels = desk.highest("hold")
        is_paused = bool(levels)
        for level in levels:
            reply = desk.give({"level": level, "what": "resume"}, wait=False)
            if not reply.worked:
                raise Failure(reply.line)
    if not is_paused:
        raise Failure(f"rack '{segment.rack}' is not paused")
    return levels
