"""`rack estop`: the emergency stop of a running rack."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from rack.backplane.lines import UtilityLines
from rack.backplane.segment import Segment
from rack.backplane.words import Demand, Run, System
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.parameters import Json, RackName

Reset = Annotated[bool, typer.Option("--reset", help="clear the latch, so that the arm may move again")]

OBEY_S = 2.0
"""Longest wait for the clock, which reads the latch every tick."""


def estop(rack: RackName, reset: Reset = False, as_json: Json = False) -> None:
    """Engage the brakes of the arm at once, and keep them engaged until --reset.

    The run continues with the arm braked. The reset is refused while a board is lost, or SYSFAIL or ACFAIL is asserted.

    Exit status: 0 the latch is set, or with --reset clear; 1 the reset was refused, or there is no such rack.

    \b
    Examples:
      rack estop nasrem
      rack estop nasrem --reset
    """
    segment = Segment.attach(rack)
    words, lines = segment.words, UtilityLines(segment)
    if segment.run_is_over:
        raise Failure(f"rack '{rack}': its run is over")
    if reset:
        lines.reset_emergency_stop()
    else:
        lines.latch_emergency_stop()
    deadline = time.monotonic() + OBEY_S
    # The demand on the arm follows at the next tick; a lost board may cause a demand, too.
    while (words[System.DEMAND] == Demand.BRAKE) == reset and words[System.STATE] == Run.RUNNING:
        if time.monotonic() > deadline:
            raise Failure(f"rack '{rack}': the latch is {'clear' if reset else 'set'}, but no tick has followed")
        time.sleep(0.001)
    tick = words[System.TICK]
    state = f"reset at tick {tick}" if reset else f"latched at tick {tick}; to release: rack estop {rack} --reset"
    document = {"rack": rack, "emergency_stop": not reset, "tick": tick}
    print_answer(document, f"rack '{rack}': emergency stop {state}", as_json)
