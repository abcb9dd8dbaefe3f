"""`rack pause` and `rack resume`: pause a rack, and let it continue.

In lockstep the rack is held between two ticks. In real time its arm comes to rest on its path, and
continues from there.
"""

from __future__ import annotations

from contextlib import closing

from rack.backplane.segment import Segment
from rack.tools.console.answer import print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RackName
from rack.tools.monitor import pausing


def pause(rack: RackName, as_json: Json = False) -> None:
    """Pause a rack until 'rack resume'.

    In lockstep the rack is held before its next tick, as by 'rack step'. In real time the clock
    keeps running. The highest level gets an operator's hold, which brings the arm to rest on its
    path. If that level is executing a different command of an operator, the level below is held
    instead.

    Exit status: 0 the rack is held, or the arm at rest; 1 there is no such rack, its run ended, or
    none of its levels can hold.

    \b
    Examples:
      rack pause nasrem
      rack resume nasrem
    """
    with INTERRUPT.raise_interrupted(), closing(Segment.attach(rack)) as segment:
        tick, levels = pausing.pause_rack(segment)
    state = f"held before tick {tick}"
    if levels:
        state = f"'{levels[0]}' held by the operator, at rest since tick {tick}"
    document = {"rack": rack, "paused": True, "levels": levels, "tick": tick}
    print_answer(document, f"rack '{rack}': {state}; to continue: rack resume {rack}", as_json)


def resume(rack: RackName, as_json: Json = False) -> None:
    """Let a paused rack continue.

    In lockstep this releases the clock, in real time the highest level that an operator holds.

    Exit status: 0 the rack continues; 1 it is not paused, or there is no such rack.

    \b
    Examples:
      rack resume nasrem
    """
    with INTERRUPT.raise_interrupted(), closing(Segment.attach(rack)) as segment:
        levels = pausing.resume_rack(segment)
    document = {"rack": rack, "paused": False, "levels": levels}
    print_answer(document, f"rack '{rack}' continues", as_json)
