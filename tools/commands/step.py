"""`rack step`: advance a rack in lockstep by single ticks or cycles."""

from __future__ import annotations

from rack.backplane.segment import Segment
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.parameters import Json, RackName, argument, option
from rack.tools.console.tables import format_fitted_records
from rack.tools.monitor.pausing import Stepper


def step(
    rack: RackName,
    cycles: int | None = argument(
        "N", "cycles of the slowest level, or of --until", None, min=1, max=1_000_000
    ),
    ticks: int | None = option(
        "--ticks N", "ticks of the clock, instead of cycles", min=1, max=10**9
    ),
    until: str | None = option("--until LEVEL", "hold after the next cycle of this level"),
    as_json: Json = False,
) -> None:
    """Advance a rack in lockstep by single cycles, and show the state of each level.

    Start the rack with 'rack run CONFIG --lockstep --step': it is then held before tick 0. A rack
    that already runs in lockstep is held by its first step. Without options the rack advances until
    every level has completed one more cycle. For a level with a state table, the current row is
    shown as well. 'rack resume' lets it run without holding.

    Exit status: 0 the steps are done; 1 there is no such rack, it is not in lockstep, or its run
    ended; 2 usage.

    \b
    Examples:
      rack step nist-state-table
      rack step nist-state-table 10
      rack step nist-state-table --until task
      rack step nist-state-table --ticks 1
    """
    if ticks is not None and (cycles is not None or until is not None):
        raise Failure("--ticks counts ticks, but N and --until count cycles; give one of them", 2)
    stepper = Stepper(Segment.attach(rack))
    held_tick = stepper.hold_rack()
    end_tick = (
        stepper.find_end_tick(held_tick, cycles or 1, until) if ticks is None else held_tick + ticks
    )
    stepper.run_to(end_tick)
    held = stepper.describe_rack()
    head = "{rack}: held before tick {tick}, {time_s:.3f} s".format_map(held)
    print_answer(held, [head, *format_fitted_records(held["levels"])], as_json)
