"""`rack pause` and `rack resume`: a rack in lockstep is held between two ticks; in real time its
arm comes to rest on its path, and goes on from there.
"""

from __future__ import annotations

from contextlib import closing

from rack.backplane.segment import Segment
from rack.tools.console.answer import print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RackName
from rack.tools.monitor import pausing


def pause(rack: RackName, as_json: Json = False) -> None:
    r"""Pause a rack until 'rack resume'.

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
    with INTERRUPT.raising(), closing(Segment.attach(rack)) as segment:
        tick, levels = pausing.pause(segment)
    what = f"held before tick {tick}"
    if levels:
        what = f"'{levels[0]}' held by the operator, at rest since tick {tick}"
    document = {"rack": rack, "paused": True, "levels": levels, "tick": tick}
    print_answer(document, f"rack '{rack}': {what}; it goes on by: rack resume {rack}", as_json)


def resume(rack: RackName, as_json: Json = False) -> None:
    r"""Let a paused rack go on: the clock in lockstep, in real time the highest level that an
    operator holds.

    Exit status: 0 it goes on; 1 it is not paused, or there is no such rack.

    \b
    Examples:
      rack resume nasrem
    """
    with INTERRUPT.raising(), closing(Segment.attach(rack)) as segment:
        levels = pausing.resume(segment)
    document = {"rack": rack, "paused": False, "levels": levels}
    print_answer(document, f"rack '{rack}' goes on", as_json)
