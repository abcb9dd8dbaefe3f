"""`rack step`: let a rack in lockstep go on by single ticks or cycles, and show what its levels
did.
"""

from __future__ import annotations

from dataclasses import asdict

from rack.backplane.segment import Segment
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.parameters import Json, RackName, argument, option
from rack.tools.monitor.pausing import Stepper


def step(
    rack: RackName,
    count: int | None = argument("N", "cycles; the same as --cycles", None, min=1, max=1_000_000),
    cycles: int | None = option(
        "--cycles N", "cycles of the slowest level, or of --until", min=1, max=1_000_000
    ),
    ticks: int | None = option(
        "--ticks N", "ticks of the clock, instead of cycles", min=1, max=10**9
    ),
    until: str | None = option("--until LEVEL", "hold after the next cycle of this level"),
    run: bool = option("--run", "let the rack run on without steps", False),
    as_json: Json = False,
) -> None:
    r"""Let a rack in lockstep go on by single cycles, and show each level's state, and the row of
    its state table.

    Start the rack with 'rack run CONFIG --lockstep --step': it holds before tick 0. A rack that
    runs in lockstep is held by its first step. Without options it goes on until every level has
    done one more cycle.

    Exit status: 0 the steps are done; 1 there is no such rack, it is not in lockstep, or its run
    ended; 2 usage.

    \b
    Examples:
      rack step nist-state-table
      rack step nist-state-table 10
      rack step nist-state-table --until task
      rack step nist-state-table --ticks 1
      rack step nist-state-table --run
    """
    if count is not None and cycles is not None:
        raise Failure(f"N = {count}: the same as --cycles; give one of them", 2)
    cycles = cycles if count is None else count
    if ticks is not None and (cycles is not None or until is not None):
        raise Failure(
            "--ticks counts ticks, N, --cycles and --until count cycles; give one of them", 2
        )
    if run and any(given is not None for given in (cycles, ticks, until)):
        raise Failure("--run lets the rack run on; leave out the steps", 2)
    stepper = Stepper(Segment.attach(rack))
    if run:
        stepper.let_go()
        print_answer({"rack": rack, "held": False}, f"rack '{rack}' runs on", as_json)
        return
    at = stepper.hold()
    end = stepper.after_cycles(at, cycles or 1, until) if ticks is None else at + ticks
    stepper.go(end)
    found = stepper.look()
    print_answer(asdict(found), found.lines(), as_json)
