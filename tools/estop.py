"""`rack estop`: the emergency stop of a running rack."""

from __future__ import annotations

from typing import Annotated

import typer

from rack.tools.answer import Failure, Json, RackName, print_json

Reset = Annotated[bool, typer.Option("--reset", help="clear the latch, provided every input is good")]

OBEY_S = 2.0
"""Bound of the wait for the clock, which looks at the latch every tick."""


def estop(rack: RackName, reset: Reset = False, as_json: Json = False) -> None:
    """Stop the arm at once: the brakes are engaged, and stay engaged until --reset.

    The run goes on with the arm braked. A reset is refused while a board is lost or holds SYSFAIL, or ACFAIL is set.

    Exit status: 0 the latch is set, or with --reset clear; 1 the reset was refused, or there is no such rack.

    \b
    Examples:
      rack estop nasrem
      rack estop nasrem --reset
    """
    import time

    from rack.backplane.lines import UtilityLines
    from rack.backplane.segment import Segment
    from rack.backplane.words import Demand, Run, System

    segment = Segment.attach(rack)
    words, lines = segment.words, UtilityLines(segment)
    if words[System.STATE] == Run.STOPPED or not segment.launcher_is_alive:
        raise Failure(f"rack '{rack}': its run is over")
    if reset:
        lines.reset_emergency_stop()
    else:
        lines.latch_emergency_stop()
    deadline = time.monotonic() + OBEY_S
    # What the arm is told follows at the next tick; a board that is lost may demand something of its own.
    while (words[System.DEMAND] == Demand.BRAKE) == reset and words[System.STATE] == Run.RUNNING:
        if time.monotonic() > deadline:
            raise Failure(f"rack '{rack}': the latch is {'clear' if reset else 'set'}; no tick has followed it")
        time.sleep(0.001)
    told = "reset" if reset else "latched"
    how = "" if reset else f"; to release: rack estop {rack} --reset"
    document = {"rack": rack, "emergency_stop": not reset, "tick": words[System.TICK]}
    print_json(document) if as_json else print(
        f"rack '{rack}': emergency stop {told} at tick {words[System.TICK]}{how}"
    )
