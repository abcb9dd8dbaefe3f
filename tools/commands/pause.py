"""`rack pause` and `rack resume`: a rack in lockstep is held between two ticks; in real time its
arm comes to rest on its path, and goes on from there."""

from __future__ import annotations

from rack.backplane.words import System
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RackName
from rack.tools.live.desk import LiveDesk
from rack.tools.live.stepper import Stepper
from rack.tools.live.watched import LocalRack


def pause(rack: RackName, as_json: Json = False) -> None:
    """Pause a rack until 'rack resume'.

    In lockstep it is held before its next tick, as by 'rack step'. In real time the clock goes on:
    the operator's hold of the highest level brings the arm to rest on its path. A level that does
    an operator's command keeps it, and the one below is held.

    Exit status: 0 the rack is held, or the arm at rest; 1 there is no such rack, its run ended, or
    none of its levels takes a hold.

    \b
    Examples:
      rack pause nasrem
      rack resume nasrem
    """
    with INTERRUPT.raising(), LocalRack(rack) as one:
        if one.segment.words[System.LOCKSTEP]:
            tick = Stepper(rack).hold()
            levels = []
            what = f"held before tick {tick}"
        else:
            level, tick = _hold(LiveDesk(one), rack)
            levels = [level]
            what = f"'{level}' held by the operator, at rest since tick {tick}"
    document = {"rack": rack, "paused": True, "levels": levels, "tick": tick}
    print_answer(document, f"rack '{rack}': {what}; it goes on by: rack resume {rack}", as_json)


def _hold(desk: LiveDesk, rack: str) -> tuple[str, int]:
    """Hold the highest level; return it, and the tick from which on the arm is at rest.

    Raises `Failure` where no level is above all others that take a hold, or it is refused.
    """
    levels = desk.highest("", "hold")
    if len(levels) != 1:
        found = ", ".join(levels) or "none"
        needed = "of the levels that take a hold one must be above all others"
        raise Failure(f"rack '{rack}' runs in real time: {needed}; highest: {found}")
    reply = desk.give({"level": levels[0], "what": "hold"}, wait=True)
    if reply.fate != "done":
        raise Failure(reply.line)
    return reply.level, reply.done


def resume(rack: RackName, as_json: Json = False) -> None:
    """Let a paused rack go on: the clock in lockstep, in real time the highest level that an
    operator holds.

    Exit status: 0 it goes on; 1 it is not paused, or there is no such rack.

    \b
    Examples:
      rack resume nasrem
    """
    with INTERRUPT.raising(), LocalRack(rack) as one:
        words = one.segment.words
        if words[System.LOCKSTEP]:
            levels: list[str] = []
            is_paused = words[System.HOLD_AT] > 0
            Stepper(rack).let_go()
        else:
            desk = LiveDesk(one)
            levels = desk.highest("hold")
            is_paused = bool(levels)
            for level in levels:
                reply = desk.give({"level": level, "what": "resume"}, wait=False)
                if not reply.worked:
                    raise Failure(reply.line)
    if not is_paused:
        raise Failure(f"rack '{rack}' is not paused")
    document = {"rack": rack, "paused": False, "levels": levels}
    print_answer(document, f"rack '{rack}' goes on", as_json)
