"""A state table: the rows of a TOML file, the words that they combine, and the row that fires.

A level's class declares the words: conditions, commands that it accepts, actions. Every set of
words is finite, so whether two rows overlap, and which case no row takes, can be decided exactly.

    start = "idle"

    [[row]]
    name = "begin a motion"
    state = "idle"                          # or a list of states
    when = { command = "move", new = "yes" }  # left out: any value; a list: any of these
    next = "moving"
    do = ["take", "begin"]
    status = "executing"

    [[row]]
    name = "nothing to do"
    state = "idle"
    else = true                             # takes what the rows of the state above this one leave
    ...

    [plan]                                  # the static plan, as the level declares it

`next = "same"` stays in the state. In every cycle the first row that matches fires, and no other.
Rows of a state exclude each other, unless the later one says `else`; together they take every case.
`rack.levels.systems.state_table.checks` sees to that before the launch.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, StringConstraints, ValidationError

from rack.backplane.bounded_toml import load_toml
from rack.backplane.message import REASON_BYTES, State
from rack.backplane.regular_file import read_regular_file
from rack.levels.errors import LevelError
from rack.levels.tables import Positive, Table, Vector

NAME_BYTES = 24
"""Longest word, name of a state, or name of a table."""
PHRASE_BYTES = 64
"""Longest command or action, with its parameters."""
TAKE = "take"
"""The action of every level: from now on the newest command is the one in force, and the status
answers it."""


Values = tuple[str, ...]
"""What a condition may be: it always has exactly one of these."""
Phrases = Mapping[str, tuple[str | Values, ...]]
"""Commands that a level accepts, or actions, by their word: one set of words for each word that
follows it; a name stands for a set of `Lexicon`."""
Lexicon = Mapping[str, Sequence[str]]
"""Sets of words that depend on scene and plan, by name: "object" -> the objects of the scene."""


@dataclass(frozen=True)
class Vocabulary:
    """All words of one kind of level. `plan` is the record of `[plan]`, the static plan in the file
    of a table.
    """

    conditions: Mapping[str, Values]
    commands: Phrases
    actions: Phrases
    plan: type[Table] = Table


def phrases(verbs: Phrases, lexicon: Lexicon) -> Iterator[str]:
    """Yield every command or action with its parameters: "pick block1"."""
    for word, parameters in verbs.items():
        for given in product(*(_words(parameter, lexicon) for parameter in parameters)):
            yield " ".join((word, *given))


def _words(parameter: str | Values, lexicon: Lexicon) -> Sequence[str]:
    return lexicon[parameter] if isinstance(parameter, str) else parameter


def objection(phrase: str, verbs: Phrases, lexicon: Lexicon) -> str:
    """Return why `phrase` is none of the commands or actions; empty: it is one."""
    if len(phrase) > PHRASE_BYTES:
        return f"'{phrase}' has {len(phrase)} characters; permitted: {PHRASE_BYTES}"
    word, *given = phrase.split() or [""]
    if word not in verbs:
        return f"unknown '{word}'; known: {', '.join(verbs) or 'none'}"
    wanted = verbs[word]
    if len(given) != len(wanted):
        return f"'{phrase}' has {len(given)} parameters; '{word}' takes {len(wanted)}"
    for value, parameter in zip(given, wanted, strict=True):
        permitted = _words(parameter, lexicon)
        if value not in permitted:
            return f"'{value}' of '{phrase}' is unknown; known: {', '.join(permitted) or 'none'}"
    return ""


MAX_FILE_BYTES = 200_000
ROW_NAME_BYTES = 48
STATES = {state.name.lower(): state for state in State}
"""States of a level, by the words of a row's `status`."""
Name = Annotated[str, StringConstraints(pattern=rf"^[a-z][a-z0-9_-]{{0,{NAME_BYTES - 1}}}$")]
RowName = Annotated[str, StringConstraints(pattern=rf"^[ -~]{{1,{ROW_NAME_BYTES}}}$")]
Reason = Annotated[str, StringConstraints(pattern=rf"^[ -~]{{1,{REASON_BYTES}}}$")]


def _listed(value: Any) -> Any:
    """Return one word as a list of one, and TOML's lists as tuples, which are frozen."""
    if isinstance(value, str):
        return (value,)
    return tuple(value) if isinstance(value, list) else value


Words = Annotated[tuple[str, ...], BeforeValidator(_listed)]
States = Annotated[tuple[Name, ...], BeforeValidator(_listed)]
Place = Annotated[Vector, BeforeValidator(_listed)]


SAME = "same"
"""The `next` of a row that stays in its state."""
LATE = "late"
"""The condition that every table may use: whether its state has lasted longer than its
`patience`."""


class RowConfig(Table):
    """`[[row]]`: one row of a state table."""

    name: RowName
    """what the row is for: shown while it fires"""
    state: States = Field(min_length=1)
    """the state, or a list of states, in which it may fire"""
    when: dict[str, Words] = {}
    """value, or a list of values, by condition"""
    otherwise: bool = Field(False, alias="else")
    """takes what the rows of the state above this one leave"""
    # Those of the next three that are missing are reported with what else is wrong with the table.
    next: Name = SAME
    """next state, or same"""
    do: Words = ()
    """actions with their parameters, in order; may be an empty list"""
    status: str = Field("error", description="state shown upwards: " + ", ".join(STATES))
    reason: Reason = ""
    """shown with status error or holding"""

    def matches(self, values: Mapping[str, str]) -> bool:
        """Return whether the row fires on these values of the conditions."""
        return all(values[condition] in permitted for condition, permitted in self.when.items())


class TableConfig(Table):
    """A state table's file."""

    start: Name
    """state in which the table begins"""
    patience: Positive = 10.0
    """time in one state after which the condition late is yes [s]"""
    row: tuple[dict[str, Any], ...] = Field(min_length=1, max_length=500)
    """its rows"""
    plan: dict[str, Any] = {}
    """the level's static plan"""


class TableError(LevelError):
    """A state table that cannot be used. `flaws` holds every mistake, a line each."""

    def __init__(self, flaws: Iterable[str]) -> None:
        self.flaws = tuple(flaws)
        super().__init__("; ".join(self.flaws))


@dataclass(frozen=True)
class StateTable:
    """A state table as read. `flaws` are the mistakes in the form of the file.

    `configs` holds the readable rows by number; rows with a mistake in their form are missing.
    """

    start: str
    patience_s: float
    configs: Mapping[int, RowConfig]
    plan: Any  # the level's record of `[plan]`; None: it has mistakes
    checksum: int  # CRC-32 of the file
    flaws: tuple[str, ...]

    @cached_property
    def rows(self) -> Mapping[str, Mapping[int, RowConfig]]:
        """The rows by state and number, each state's in their order."""
        rows: dict[str, dict[int, RowConfig]] = {}
        for number, row in self.configs.items():
            for state in row.state:
                rows.setdefault(state, {})[number] = row
        return rows

    def decide(self, state: str, values: Mapping[str, str]) -> tuple[int, RowConfig]:
        """Return the row that fires, after its number; number 0, an error: no row takes the case,
        which cannot happen in a table that was checked.
        """
        for number, row in self.rows.get(state, {}).items():
            if row.matches(values):
                return number, row
        case = ", ".join(f"{name} = {value}" for name, value in values.items())
        reason = f"no row of '{state}' takes {case}"
        return 0, RowConfig.model_construct(name="", state=(state,), next=state, reason=reason)


def read_table(path: Path, vocabulary: Vocabulary) -> StateTable:
    """Return the table in a file, unchecked. Raises `TableError` when it cannot be read at all."""
    try:
        data = read_regular_file(path, MAX_FILE_BYTES)
        config = TableConfig.model_validate(load_toml(data.decode()))
    except OSError as error:
        raise TableError([f"cannot be read: {error.strerror}"]) from error
    except ValidationError as error:
        raise TableError(_flaws(error, "", TableConfig)) from error
    except ValueError as error:  # TOML, UTF-8
        raise TableError([f"not TOML: {error}"]) from error
    configs = {}
    flaws = list[str]()
    plan = None
    for number, row in enumerate(config.row, 1):
        try:
            configs[number] = RowConfig.model_validate(row)
        except ValidationError as error:
            flaws += _flaws(error, f"row {number}: ", RowConfig)
    try:
        plan = vocabulary.plan.model_validate(config.plan)
    except ValidationError as error:
        flaws += _flaws(error, "plan: ", vocabulary.plan)
    return StateTable(config.start, config.patience, configs, plan, zlib.crc32(data), tuple(flaws))


def _flaws(error: ValidationError, place: str, kind: type[Table]) -> list[str]:
    """Return what is wrong with one table of a file, a line each."""
    known = ", ".join(field.alias or key for key, field in kind.model_fields.items())
    lines = []
    for entry in error.errors(include_url=False):
        key = ".".join(str(part) for part in entry["loc"])
        message = entry["msg"]
        why = f"{str(entry['input'])[:40]!r}: {message[0].lower()}{message[1:]}"
        if entry["type"] == "missing":
            why = "missing"
        elif entry["type"] == "extra_forbidden":
            why = f"unknown key; known: {known}"
        lines.append(f"{place}{key}: {why}")
    return lines
