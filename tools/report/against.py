"""Comparison of two runs, as data and as text: where they diverge, and why."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict

from rack.backplane.address_map import CLOCK
from rack.tools.console.answer import Document, Failure
from rack.tools.monitor.signals import format_value
from rack.tools.recording.causes import Divergence, DivergentCycle, ValueDifference
from rack.tools.recording.divergence import Difference
from rack.tools.recording.history import list_misses
from rack.tools.recording.recording import Recording
from rack.tools.report.cycle_again import Repetition, repeat_cycle
from rack.tools.report.report import OtherRun

MAX_SHOWN = 4
"""Largest number of fields or attributes that the text lists. report.json contains all."""
INCONCLUSIVE_CLUES = ("config", "outside")
"""Kinds of clues after which a difference in the level's state or code is still possible."""


def compare_runs(recording: Recording, other_run: OtherRun) -> Document:
    """Compare a run with another one, and explain their first difference.

    Args:
        recording: The run.
        other_run: The other run, and options of the comparison.

    Returns:
        The entry "against" of report.json.

    Raises:
        Failure: The runs cannot be compared.
    """
    divergence = Divergence(recording, Recording(other_run.folder))
    first_miss = min(
        (miss["tick"] for run in divergence.runs for miss in list_misses(run)), default=None
    )
    first = next(iter(divergence.divergent.values()), None)
    chain = divergence.trace_cause(other_run.mailbox)
    repetition = (
        _repeat_if_unexplained(divergence, chain[-1], other_run.may_repeat) if chain else ""
    )
    other_folder = str(other_run.folder)
    lines = [line for cycle in chain for line in _format_cycle(cycle, other_folder)]
    why_not = ""
    if isinstance(repetition, Repetition):
        lines += _format_repetition(repetition, chain[-1], other_folder)
    elif why_not := repetition:
        lines.append(f"not repeated: {why_not}")
    if other_run.mailbox and not chain:
        lines.append(f"{other_run.mailbox} is equal in both")
    return {
        "folder": other_folder,
        "first_difference": first and asdict(Difference(first.tick, first.mailbox)),
        "first_miss_tick": first_miss,
        "explained": first is None or (first_miss is not None and first_miss <= first.tick),
        "chain": [asdict(cycle) for cycle in chain],
        "repetition": asdict(repetition) if isinstance(repetition, Repetition) else None,
        "not_repeated": why_not,
        "why": lines,
    }


def _repeat_if_unexplained(
    divergence: Divergence, last: DivergentCycle, is_wanted: bool
) -> Repetition | str:
    """Repeat the cycle that diverged, if its cause is still unknown.

    Args:
        divergence: The comparison of the two runs.
        last: The cycle at the end of the causal chain.
        is_wanted: Whether the user allows a repetition.

    Returns:
        The result of the repetition, or the reason why the cycle was not repeated. "" if the clues
        already explain the difference, so that no repetition is needed.
    """
    if last.unequal or any(clue.kind not in INCONCLUSIVE_CLUES for clue in last.clues):
        return ""
    if not is_wanted:
        return "--repeat runs both racks again, up to that cycle"
    print(f"repeating tick {last.tick} in both runs", file=sys.stderr)
    try:
        return repeat_cycle(divergence, last)
    except Failure as failure:
        return str(failure)


def _format_cycle(cycle: DivergentCycle, other: str) -> Iterator[str]:
    """Yield sentences on how a cycle's message differs, on its inputs, and on possible causes."""
    yield (
        f"at tick {cycle.tick}: "
        f"{_join_clauses(_format_field(cycle, field, other) for field in cycle.fields)}"
    )
    if cycle.unequal:
        yield f"'{cycle.writer}' wrote it after reading {cycle.unequal}, which already differed"
    elif cycle.writer == CLOCK:
        yield "the clock wrote it for an operator"
    elif cycle.read:
        names = ", ".join(cycle.read)
        yield f"'{cycle.writer}' wrote it; all its inputs were equal up to that tick: {names}"
    else:
        yield f"'{cycle.writer}' wrote it; it reads no mailbox"
    settings = [clue.values for clue in cycle.clues if clue.values is not None]
    yield from (
        f"in {clue.run} only, at tick {clue.tick}: {clue.text}" if clue.run else clue.text
        for clue in cycle.clues
        if clue.values is None
    )
    if settings:
        yield _join_clauses(_format_difference(values, other, "not set") for values in settings)
    if not (cycle.clues or cycle.unequal):
        yield f"no fault, loss, miss or setting of '{cycle.writer}' differs"


def _format_field(cycle: DivergentCycle, field: ValueDifference, other_folder: str) -> str:
    """Return a clause that says how a field differs, or which run lacks the message."""
    box = cycle.mailbox
    values = field.here, field.there
    match field.name, *values:
        case "tick", here, None:
            return f"{box} has a message that {other_folder} lacks"
        case "tick", None, other:
            return f"{box} lacks a message that {other_folder} has"
        case "tick", here, other:
            return f"{box} was written at tick {here}, in {other_folder} at tick {other}"
        case "visible_at", here, other:
            return f"{box} was visible from tick {here}, in {other_folder} from tick {other}"
        case "basis", here, other:
            return f"{box} is based on tick {here}, in {other_folder} on tick {other}"
    return _format_difference(field, other_folder)


def _format_difference(difference: ValueDifference, other_folder: str, absent: str = "-") -> str:
    """Return a clause with both values of a field, setting or attribute.

    Args:
        difference: The two values.
        other_folder: Folder of the other run.
        absent: Text for a value that a run does not have.
    """
    values = (difference.here, difference.there)
    texts = [absent if value is None else format_value(value) or '""' for value in values]
    if texts[0] == texts[1]:
        # The numbers differ only in digits that the short format does not show.
        texts = [*map(repr, values)]
    return f"{difference.name} is {texts[0]}, in {other_folder} {texts[1]}"


def _join_clauses(texts: Iterator[str]) -> str:
    """Join the first `MAX_SHOWN` clauses, and append the number of omitted clauses, if any."""
    clauses = [*texts]
    more = [f"{len(clauses) - MAX_SHOWN} more"] if len(clauses) > MAX_SHOWN else []
    return "; ".join([*clauses[:MAX_SHOWN], *more])


def _format_repetition(repetition: Repetition, cycle: DivergentCycle, other: str) -> Iterator[str]:
    """Yield sentences on the result of repeating a cycle: differing attributes, and the cause."""
    task = cycle.writer
    runs = " and ".join(repetition.runs)
    if repetition.attributes:
        attributes = _join_clauses(
            _format_difference(attribute, other) for attribute in repetition.attributes
        )
        yield f"before that cycle the state of '{task}' differed: {attributes}"
    else:
        yield f"before that cycle the state of '{task}' was equal, as far as it can be compared"
    if repetition.because == "chance":
        yield (
            f"'{task}' writes something else at each repetition of {runs}: it depends on something"
            " besides messages, ticks and parameters, such as a clock, random numbers or the order"
            " of a set"
        )
    elif repetition.because == "code":
        yield f"'{task}' now writes something else in {runs}: its code has changed since the run"
    else:
        yield f"'{task}' repeats both messages, so its code has not changed"
    for run, names in repetition.strays.items():
        yield f"uncertain: repeated, {run} also differs from its recording in {', '.join(names)}"
