"""Repeats a cycle of two recorded runs, to find out why its message differed.

The inputs of the cycle were equal in both runs (see `rack.tools.recording.causes`). The cycle is
repeated several times in each run, with three possible results. If all repetitions write the
recorded message, the state or the parameters of the level differed between the runs. If they write
another message, but always the same, the level's code has changed since the run. If they write
different messages, the level depends on something besides messages, ticks and parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from rack.backplane.address_map import CLOCK
from rack.backplane.mailbox.history import find_chains
from rack.tools.console.answer import Failure, convert_errors
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.launch.continued import RepeatedRun, list_differing_mailboxes
from rack.tools.recording.causes import Divergence, DivergentCycle, ValueDifference, compare_values
from rack.tools.recording.recording import Recording

REPETITIONS = 2
"""Number of times that a cycle is repeated in each run."""
Because = Literal["state", "code", "chance"]


@dataclass(frozen=True)
class Repetition:
    """Result of repeating a cycle in two runs.

    Attributes:
        attributes: Attributes of the level that differed between the runs before the cycle.
        because: Cause of the difference: "state" if both runs repeated their recorded messages, so
            that the state or the parameters differed; "code" if the level's code has changed since
            one of the runs; "chance" if repetitions of the same run differed.
        runs: Folders of the runs that did not repeat their recorded message.
        strays: For each run, the mailboxes of other levels that differed from the recording. If
            there are any, the result is uncertain.
    """

    attributes: tuple[ValueDifference, ...]
    because: Because
    runs: tuple[str, ...]
    strays: Mapping[str, tuple[str, ...]]


class _RepeatedCycle(NamedTuple):
    """A repeated cycle of one run.

    Attributes:
        attributes: Attributes of the level before the cycle.
        differing_mailboxes: Mailboxes whose messages differ from the recording.
        is_equal: True if all repetitions wrote the same message.
    """

    attributes: Mapping[str, Any]
    differing_mailboxes: tuple[str, ...]
    is_equal: bool


def repeat_cycle(divergence: Divergence, cycle: DivergentCycle) -> Repetition:
    """Repeat a cycle in both runs.

    Raises:
        Failure: The cycle cannot be repeated. The message says why.
    """
    if cycle.writer == CLOCK:
        raise Failure("the clock wrote that message, and only levels can be repeated")
    for run in divergence.runs:
        if run.rack_config.clock.mode != "lockstep":
            raise Failure(f"{run.folder} ran in real time, and only lockstep can be repeated")
    until = divergence.divergent[cycle.mailbox].visible_at + 1
    with INTERRUPT.raise_interrupted(), convert_errors():
        again_by_run = {run: _repeat_in_run(run, cycle, until) for run in divergence.runs}
    not_repeating = [
        run for run in divergence.runs if cycle.mailbox in again_by_run[run].differing_mailboxes
    ]
    is_chance = not all(again_by_run[run].is_equal for run in not_repeating)
    layout = divergence.runs[0].layout
    strays = {
        str(run.folder): tuple(
            name
            for name in again_by_run[run].differing_mailboxes
            if layout.find_mailbox(name).writer != cycle.writer
        )
        for run in divergence.runs
    }
    because: Because = "code" if not_repeating else "state"
    return Repetition(
        attributes=tuple(
            compare_values(*(again_by_run[run].attributes for run in divergence.runs))
        ),
        because="chance" if is_chance else because,
        runs=tuple(str(run.folder) for run in not_repeating),
        strays={folder: names for folder, names in strays.items() if names},
    )


def _repeat_in_run(run: Recording, cycle: DivergentCycle, until: int) -> _RepeatedCycle:
    """Repeat a cycle of one run `REPETITIONS` times.

    Args:
        run: The run.
        cycle: The cycle.
        until: Tick up to which the rack is run, one after the cycle's message becomes visible.
    """
    with RepeatedRun(run, f"{run.folder} at tick {cycle.tick}", anyway=True) as again:
        attributes = again.read_levels(cycle.tick)[cycle.writer]
        repetitions = []
        for _ in range(REPETITIONS):
            with again.run_rack_to(until) as rack:
                # Serial and chained checksum identify the message that the cycle wrote.
                wrote = find_chains(rack.segment, until)[cycle.mailbox]
                repetitions.append(
                    (wrote, tuple(list_differing_mailboxes(run, rack.segment, until)))
                )
    wrote, differing = repetitions[0]
    return _RepeatedCycle(
        attributes, differing, all(repetition == wrote for repetition, _ in repetitions)
    )
