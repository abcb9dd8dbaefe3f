"""A cycle of two recorded runs, repeated in both: was the level's state equal before it, and does
its code do again what it did?

The inputs of that cycle were equal in both, see `rack.tools.recording.causes`. A run that does not
repeat its own message now has a level whose code has changed since or, if it does not even repeat
itself, one that depends on something besides messages, ticks and parameters. If both repeat theirs,
what differs is the state of the level or its parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

from rack.backplane.address_map import CLOCK
from rack.backplane.mailbox.history import chains
from rack.boards.checkpoint.format import checkpoints
from rack.boards.wiring import Keeping
from rack.tools.console.answer import Failure, as_failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.live.continued import (
    attributes_in,
    begun_before,
    gone_on,
    state_at,
    unlike_in,
)
from rack.tools.live.launch import Beginning
from rack.tools.recording.causes import Divergence, InBoth, UnlikeCycle, unlike_values
from rack.tools.recording.entries import commands_from
from rack.tools.recording.origin import continued_at
from rack.tools.recording.recording import Recording

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
    """A repeated cycle: the attributes of its level before it, serial and chain of what it wrote,
    and the mailboxes that are not as recorded."""

    attributes: Mapping[str, Any]
    wrote: tuple[int, int]
    unlike: tuple[str, ...]


def repeated(found: Divergence, cycle: UnlikeCycle) -> Repetition:
    """Repeat a cycle in both runs. Raises `Failure` if that is impossible, with the reason."""
    if cycle.writer == CLOCK:
        raise Failure("the clock wrote that message")
    for run in found.runs:
        if run.rack_config.clock.mode != "lockstep":
            raise Failure(f"{run.folder} ran in real time")
    until = found.unlike[cycle.mailbox].visible_at + 1
    one, other = found.runs
    parents = {one: other, other: one}
    with INTERRUPT.raising(), as_failure():
        again = {run: _again(run, parents[run], cycle, until, shows=True) for run in found.runs}
        others = [run for run in found.runs if cycle.mailbox in again[run].unlike]
        # Nothing is kept before it this time: that takes long enough for a level that looks at a
        # clock.
        is_chance = any(
            _again(run, parents[run], cycle, until, shows=False).wrote != again[run].wrote
            for run in others
        )
    layout = one.layout
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


def _again(
    run: Recording, parent: Recording, cycle: UnlikeCycle, until: int, *, shows: bool
) -> _Again:
    """Repeat a cycle of a run until what it writes is visible; with `shows`, with the attributes of
    its level."""
    asked = f"{run.folder} at tick {cycle.tick}"
    attributes: Mapping[str, Any] = {}
    with ExitStack() as stack:
        begins = stack.enter_context(_beginning(run, parent, cycle.tick, asked))
        path = Path(stack.enter_context(TemporaryDirectory(prefix="rack-")))
        if shows:
            kept = replace(begins.checkpoint or Keeping(), folder=path, at=cycle.tick, shows=True)
            begins = replace(begins, checkpoint=kept)
        rack = stack.enter_context(gone_on(run, begins, until, asked))
        if shows:
            attributes = attributes_in(path)[cycle.writer]
        wrote = chains(rack.segment, until)[cycle.mailbox]
        return _Again(attributes, wrote, tuple(unlike_in(run, rack.segment, until)))


@contextmanager
def _beginning(run: Recording, parent: Recording, tick: int, asked: str) -> Iterator[Beginning]:
    """Yield what a run goes on from to the cycle: a branch without a checkpoint until then from the
    other run, at the tick at which it branched off."""
    branched_at = continued_at(run)
    if branched_at is None or _has_checkpoint(run, tick):
        yield begun_before(run, tick, asked)[1]
        return
    if continued_at(parent) is not None and not _has_checkpoint(parent, branched_at):
        why = f"has no checkpoint before tick {tick}, and is no branch of {parent.folder}"
        raise Failure(f"{run.folder} {why}")
    with state_at(parent, branched_at) as state:
        keeping = state.begins.checkpoint
        assert keeping is not None, "a state that is kept"
        keeping = replace(keeping, packages=run.rack_config.python_path)
        yield replace(state.begins, checkpoint=keeping, requests=commands_from(run, branched_at))


def _has_checkpoint(run: Recording, until: int) -> bool:
    return any(at <= until for at in checkpoints(run.folder))
