"""A cycle of two recorded runs, repeated in both: was the level's state equal before it, and does
its code do again what it did?

The inputs of that cycle were equal in both, see `rack.tools.recording.causes`. A run that does not
repeat its own message now has a level whose code has changed since or, if it does not even repeat
itself, one that depends on something besides messages, ticks and parameters. If both repeat theirs,
what differs is the state of the level or its parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from rack.backplane.address_map import CLOCK
from rack.backplane.mailbox.history import chains
from rack.tools.console.answer import Failure, as_failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.launch.continued import RunAgain, unlike_in
from rack.tools.recording.causes import Divergence, InBoth, UnlikeCycle, unlike_values
from rack.tools.recording.recording import Recording

TIMES = 2
"""How often a cycle is repeated."""
Because = Literal["state", "code", "chance"]


@dataclass(frozen=True)
class Repetition:
    """What the repetition of a cycle in two runs has shown.

    `attributes` of the level differed before it. `because`: "state", or parameters, if each run
    repeats its own message; "code" if that of the level has changed since one of them; "chance" if
    it does not repeat itself. `runs` are those that do not repeat theirs. `strays`: mailboxes of
    others that are not as recorded, by run, so that nothing of this is sure.
    """

    attributes: tuple[InBoth, ...]
    because: Because
    runs: tuple[str, ...]
    strays: Mapping[str, tuple[str, ...]]


class _Again(NamedTuple):
    """A repeated cycle: the attributes of its level before it, the mailboxes that are not as
    recorded, and whether it wrote the same each time.
    """

    attributes: Mapping[str, Any]
    unlike: tuple[str, ...]
    is_equal: bool


def repeated(found: Divergence, cycle: UnlikeCycle) -> Repetition:
    """Repeat a cycle in both runs. Raises `Failure` if that is impossible, with the reason."""
    if cycle.writer == CLOCK:
        raise Failure("the clock wrote that message")
    for run in found.runs:
        if run.rack_config.clock.mode != "lockstep":
            raise Failure(f"{run.folder} ran in real time")
    until = found.unlike[cycle.mailbox].visible_at + 1
    with INTERRUPT.raising(), as_failure():
        again = {run: _again(run, cycle, until) for run in found.runs}
    others = [run for run in found.runs if cycle.mailbox in again[run].unlike]
    is_chance = not all(again[run].is_equal for run in others)
    layout = found.runs[0].layout
    strays = {
        str(run.folder): tuple(
            name for name in again[run].unlike if layout.mailbox(name).writer != cycle.writer
        )
        for run in found.runs
    }
    because: Because = "code" if others else "state"
    return Repetition(
        attributes=tuple(unlike_values(*(again[run].attributes for run in found.runs))),
        because="chance" if is_chance else because,
        runs=tuple(str(run.folder) for run in others),
        strays={folder: names for folder, names in strays.items() if names},
    )


def _again(run: Recording, cycle: UnlikeCycle, until: int) -> _Again:
    """Repeat a cycle of a run until what it writes is visible."""
    with RunAgain(run, f"{run.folder} at tick {cycle.tick}", anyway=True) as again:
        attributes = again.levels(cycle.tick)[cycle.writer]
        found = []
        for _ in range(TIMES):
            with again.rack_at(until) as rack:
                # Serial and chain of what it wrote.
                wrote = chains(rack.segment, until)[cycle.mailbox]
                found.append((wrote, tuple(unlike_in(run, rack.segment, until))))
    wrote, unlike = found[0]
    return _Again(attributes, unlike, all(one == wrote for one, _ in found))
