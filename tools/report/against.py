"""Comparison of two runs, as data and as text: where they diverge, and why."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict

from rack.backplane.address_map import CLOCK
from rack.tools.console.answer import Document, Failure
from rack.tools.monitor.signals import cell
from rack.tools.recording.causes import Clue, Divergence, InBoth, UnlikeCycle
from rack.tools.recording.divergence import Difference
from rack.tools.recording.history import misses
from rack.tools.recording.recording import Recording
from rack.tools.report.cycle_again import Repetition, repeated
from rack.tools.report.report import OtherRun

SHOWN = 4
"""Number of fields, attributes and so on that the text lists. The data contain all."""
OF_CONFIG = ("config", "outside")
"""Kinds of clues that do not rule out a difference in the level's state."""


def compared(recording: Recording, other_run: OtherRun) -> Document:
    """Compare a run with another one, and explain the difference.

    Raises:
        Failure: The runs cannot be compared.
    """
    divergence = Divergence(recording, Recording(other_run.folder))
    first_miss = min(
        (miss["tick"] for run in divergence.runs for miss in misses(run)), default=None
    )
    first = next(iter(divergence.unlike.values()), None)
    chain = divergence.chain(other_run.of)
    repetition = _repeated(divergence, chain[-1], other_run.repeats) if chain else ""
    other_folder = str(other_run.folder)
    lines = [line for cycle in chain for line in _cycle_lines(cycle, other_folder)]
    why_not = ""
    if isinstance(repetition, Repetition):
        lines += _repetition_lines(repetition, chain[-1], other_folder)
    elif why_not := repetition:
        lines.append(f"not repeated: {why_not}")
    if other_run.of and not chain:
        lines.append(f"{other_run.of} is equal in both")
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


def _repeated(divergence: Divergence, last: UnlikeCycle, is_wanted: bool) -> Repetition | str:
    """Repeat the cycle that diverged, if that can add anything to the clues.

    Args:
        divergence: The comparison.
        last: The cycle at the end of the causal chain.
        is_wanted: Whether the user allows a repetition.

    Returns:
        The result, or the reason why there is none. "" if the clues already exclude state and code.
    """
    if last.unequal or any(clue.kind not in OF_CONFIG for clue in last.clues):
        return ""
    if not is_wanted:
        return "--repeat runs both racks again, up to that cycle"
    print(f"repeating tick {last.tick} in both runs", file=sys.stderr)
    try:
        return repeated(divergence, last)
    except Failure as failure:
        return str(failure)


def _cycle_lines(cycle: UnlikeCycle, other: str) -> Iterator[str]:
    """Yield sentences about a cycle: the difference, its inputs, and possible causes."""
    yield f"at tick {cycle.tick}: {_several(_field(cycle, field, other) for field in cycle.fields)}"
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
    yield from (_clue(clue) for clue in cycle.clues if clue.values is None)
    if settings:
        yield _several(_values(values, other, "not set") for values in settings)
    if not (cycle.clues or cycle.unequal):
        yield f"no fault, loss, miss or setting of '{cycle.writer}' differs"


def _field(cycle: UnlikeCycle, field: InBoth, other_folder: str) -> str:
    """Return a clause about a field that differs."""
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
    return _values(field, other_folder)


def _values(difference: InBoth, other_folder: str, absent: str = "-") -> str:
    """Return a clause with both values of a field or setting."""
    texts = [_text(value, absent) for value in (difference.here, difference.there)]
    if texts[0] == texts[1]:
        # The numbers differ only in a digit that is not shown.
        texts = [repr(difference.here), repr(difference.there)]
    return f"{difference.name} is {texts[0]}, in {other_folder} {texts[1]}"


def _text(value: object, absent: str) -> str:
    """Format a value. None becomes the text `absent`."""
    return absent if value is None else cell(value) or '""'


def _several(texts: Iterator[str]) -> str:
    """Join clauses. Beyond `MAX_SHOWN` clauses, only the number of the others is given."""
    clauses = [*texts]
    more = [f"{len(clauses) - SHOWN} more"] if len(clauses) > SHOWN else []
    return "; ".join([*clauses[:SHOWN], *more])


def _clue(clue: Clue) -> str:
    """Return a sentence for a clue."""
    return f"in {clue.run} only, at tick {clue.tick}: {clue.text}" if clue.run else clue.text


def _repetition_lines(repetition: Repetition, cycle: UnlikeCycle, other: str) -> Iterator[str]:
    """Yield sentences about the result of a repetition."""
    task = cycle.writer
    runs = " and ".join(repetition.runs)
    if repetition.attributes:
        attributes = _several(_values(attribute, other) for attribute in repetition.attributes)
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
