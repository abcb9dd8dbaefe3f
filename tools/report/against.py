"""Two runs compared: where they diverge, and why, as data and as text."""

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
"""Fields, attributes and the like that the text names; the data have all."""
OF_CONFIG = ("config", "outside")
"""Kinds of clues that leave open whether a level's state was equal."""


def compared(recording: Recording, asked: OtherRun) -> Document:
    """Return where two runs diverge, and why. Raises `Failure` when they cannot be compared."""
    found = Divergence(recording, Recording(asked.folder))
    missed = min((miss["tick"] for run in found.runs for miss in misses(run)), default=None)
    first = next(iter(found.unlike.values()), None)
    chain = found.chain(asked.of)
    repetition = _repeated(found, chain[-1], asked.repeats) if chain else ""
    there = str(asked.folder)
    lines = [line for cycle in chain for line in _cycle_lines(cycle, there)]
    why_not = ""
    if isinstance(repetition, Repetition):
        lines += _repetition_lines(repetition, chain[-1], there)
    elif why_not := repetition:
        lines.append(f"not repeated: {why_not}")
    if asked.of and not chain:
        lines.append(f"{asked.of} is equal in both")
    return {
        "folder": there,
        "first_difference": first and asdict(Difference(first.tick, first.mailbox)),
        "first_miss_tick": missed,
        "explained": first is None or (missed is not None and missed <= first.tick),
        "chain": [asdict(cycle) for cycle in chain],
        "repetition": asdict(repetition) if isinstance(repetition, Repetition) else None,
        "not_repeated": why_not,
        "why": lines,
    }


def _repeated(found: Divergence, last: UnlikeCycle, is_wanted: bool) -> Repetition | str:
    """Return what repeating a cycle shows, or why it is not repeated: "" if the recordings say
    already that it was not the level's state or code.
    """
    if last.unequal or any(clue.kind not in OF_CONFIG for clue in last.clues):
        return ""
    if not is_wanted:
        return "--repeat runs both racks again, to that cycle"
    print(f"repeating tick {last.tick} in both runs", file=sys.stderr)
    try:
        return repeated(found, last)
    except Failure as failure:
        return str(failure)


def _cycle_lines(cycle: UnlikeCycle, there: str) -> Iterator[str]:
    yield f"at tick {cycle.tick}: {_several(_field(cycle, one, there) for one in cycle.fields)}"
    if cycle.unequal:
        yield f"'{cycle.writer}' wrote that, and had read {cycle.unequal}, which differed"
    elif cycle.writer == CLOCK:
        yield "the clock wrote that, for an operator"
    elif cycle.read:
        names = ", ".join(cycle.read)
        yield f"'{cycle.writer}' wrote that; all that it had read was equal until then: {names}"
    else:
        yield f"'{cycle.writer}' wrote that; it reads no mailbox"
    settings = [clue.values for clue in cycle.clues if clue.values is not None]
    yield from (_clue(clue) for clue in cycle.clues if clue.values is None)
    if settings:
        yield _several(_values(values, there, "not set") for values in settings)
    if not (cycle.clues or cycle.unequal):
        yield f"no fault, loss, miss or setting of '{cycle.writer}' differs"


def _field(cycle: UnlikeCycle, field: InBoth, there: str) -> str:
    box = cycle.mailbox
    values = field.here, field.there
    match field.name, *values:
        case "tick", here, None:
            return f"{box} has a message that {there} lacks"
        case "tick", None, other:
            return f"{box} lacks a message that {there} has"
        case "tick", here, other:
            return f"{box} was written at tick {here}, in {there} at tick {other}"
        case "visible_at", here, other:
            return f"{box} was visible from tick {here}, in {there} from tick {other}"
        case "basis", here, other:
            return f"{box} rests on information of tick {here}, in {there} of tick {other}"
    return _values(field, there)


def _values(found: InBoth, there: str, absent: str = "-") -> str:
    texts = [_text(value, absent) for value in (found.here, found.there)]
    if texts[0] == texts[1]:
        # Numbers that differ in a late digit only.
        texts = [repr(found.here), repr(found.there)]
    return f"{found.name} is {texts[0]}, in {there} {texts[1]}"


def _text(value: object, absent: str) -> str:
    return absent if value is None else cell(value) or '""'


def _several(texts: Iterator[str]) -> str:
    found = [*texts]
    more = [f"{len(found) - SHOWN} more"] if len(found) > SHOWN else []
    return "; ".join([*found[:SHOWN], *more])


def _clue(clue: Clue) -> str:
    return f"in {clue.run} only, at tick {clue.tick}: {clue.text}" if clue.run else clue.text


def _repetition_lines(found: Repetition, cycle: UnlikeCycle, there: str) -> Iterator[str]:
    task = cycle.writer
    runs = " and ".join(found.runs)
    if found.attributes:
        shown = _several(_values(one, there) for one in found.attributes)
        yield f"before that cycle the state of '{task}' differed: {shown}"
    else:
        yield f"before that cycle the state of '{task}' was equal, as far as it can be shown"
    if found.because == "chance":
        yield (
            f"'{task}' does not repeat in {runs}: it depends on something besides messages, ticks"
            " and parameters, such as a clock, random numbers or the order of a set"
        )
    elif found.because == "code":
        yield f"'{task}' now writes something else in {runs}: its code has changed since then"
    else:
        yield f"'{task}' repeats both messages: its code is the same"
    for run, names in found.strays.items():
        yield f"not sure: repeated, {run} differs in {', '.join(names)} too, from its recording"
