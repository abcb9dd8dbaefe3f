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
    else = true                             # fires when no earlier row of the state does
    ...

    [plan]                                  # the static plan, as the level declares it

`next = "same"` stays in the state. In every cycle only the first matching row fires. The rows of a
state exclude each other, unless the later one says `else`, and together they cover every case.
`rack.levels.systems.state_table.checks` verifies this before the launch.
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
from rack.levels.tables import Positive, Table, Vector, to_tuple

MAX_NAME_BYTES = 24
"""Maximum length of a word, a state's name or a table's name."""
MAX_PHRASE_BYTES = 64
"""Maximum length of a command or action with its parameters."""
TAKE = "take"
"""Action that makes the newest command the current one. The status then refers to this command."""


Values = tuple[str, ...]
"""Possible values of a condition. In every cycle it has exactly one of them."""
Phrases = Mapping[str, tuple[str | Values, ...]]
"""Dictionary from the first word of each accepted command or action to its parameters.

Each parameter is a tuple of permitted words, or the name of a set of words in
`Lexicon`.
"""
Lexicon = Mapping[str, Sequence[str]]
"""Sets of words that depend on the scene and the plan.

For example, "object" names the objects of the scene.
"""


@dataclass(frozen=True)
class Vocabulary:
    """All words of one kind of level.

    Attributes:
        conditions: Possible values of each condition.
        commands: Commands that the level accepts.
        actions: Actions that rows may name in `do`.
        plan: Record class of `[plan]`, the static plan in a table's file.
    """

    conditions: Mapping[str, Values]
    commands: Phrases
    actions: Phrases
    plan: type[Table] = Table


def list_phrases(verbs: Phrases, lexicon: Lexicon) -> Iterator[str]:
    """Yield every verb with every combination of permitted parameters, such as "pick block1"."""
    for word, parameters in verbs.items():
        for arguments in product(*(_list_words(parameter, lexicon) for parameter in parameters)):
            yield " ".join((word, *arguments))


def _list_words(parameter: str | Values, lexicon: Lexicon) -> Sequence[str]:
    """Return the permitted words of a parameter.

    The parameter contains the words, or is the name of a set of words in `lexicon`.
    """
    return lexicon[parameter] if isinstance(parameter, str) else parameter


def find_phrase_error(phrase: str, verbs: Phrases, lexicon: Lexicon) -> str:
    """Return why a phrase is not a valid command or action, or an empty string if it is.

    Args:
        phrase: Command or action with its parameters.
        verbs: Dictionary from the first word of each command or action to its parameters.
        lexicon: Sets of words that depend on the scene and the plan.
    """
    if len(phrase) > MAX_PHRASE_BYTES:
        return f"'{phrase}' has {len(phrase)} characters; permitted: {MAX_PHRASE_BYTES}"
    word, *arguments = phrase.split() or [""]
    if word not in verbs:
        return f"unknown '{word}'; known: {', '.join(verbs) or 'none'}"
    parameters = verbs[word]
    if len(arguments) != len(parameters):
        return f"'{phrase}' has {len(arguments)} parameters; '{word}' takes {len(parameters)}"
    for value, parameter in zip(arguments, parameters, strict=True):
        permitted = _list_words(parameter, lexicon)
        if value not in permitted:
            return f"'{value}' of '{phrase}' is unknown; known: {', '.join(permitted) or 'none'}"
    return ""


MAX_FILE_BYTES = 200_000
MAX_ROW_NAME_BYTES = 48
STATES = {state.name.lower(): state for state in State}
"""Dictionary from the words of a row's `status` to states of a level."""
Name = Annotated[str, StringConstraints(pattern=rf"^[a-z][a-z0-9_-]{{0,{MAX_NAME_BYTES - 1}}}$")]
RowName = Annotated[str, StringConstraints(pattern=rf"^[ -~]{{1,{MAX_ROW_NAME_BYTES}}}$")]
Reason = Annotated[str, StringConstraints(pattern=rf"^[ -~]{{1,{REASON_BYTES}}}$")]


Words = Annotated[tuple[str, ...], BeforeValidator(to_tuple)]
States = Annotated[tuple[Name, ...], BeforeValidator(to_tuple)]
Place = Annotated[Vector, BeforeValidator(to_tuple)]


SAME = "same"
"""Value of `next` in a row that stays in its state."""
LATE = "late"
"""Condition of every table: whether its state has lasted longer than its `patience`."""


class RowConfig(Table):
    """`[[row]]`: one row of a state table."""

    name: RowName
    """purpose of the row, shown while it fires"""
    state: States = Field(min_length=1)
    """the state, or a list of states, in which it may fire"""
    when: dict[str, Words] = {}
    """required value, or list of accepted values, by condition"""
    otherwise: bool = Field(False, alias="else")
    """fires in every case that the earlier rows of the state leave"""
    # The next three keys are required. They have defaults because a missing key is reported
    # together with all other mistakes of the table.
    next: Name = SAME
    """next state, or same"""
    do: Words = ()
    """actions with their parameters, in order; the list may be empty"""
    status: str = Field("error", description="state shown upwards: " + ", ".join(STATES))
    reason: Reason = ""
    """shown with status error or holding"""

    def matches_case(self, values: Mapping[str, str]) -> bool:
        """Return True if the row fires for these values of the conditions."""
        return all(values[condition] in permitted for condition, permitted in self.when.items())


class TableConfig(Table):
    """File of a state table."""

    start: Name
    """initial state"""
    patience: Positive = 10.0
    """time in one state after which the condition late is yes [s]"""
    row: tuple[dict[str, Any], ...] = Field(min_length=1, max_length=500)
    """its rows"""
    plan: dict[str, Any] = {}
    """the level's static plan"""


class TableError(LevelError):
    """Raised for a state table that cannot be used.

    Attributes:
        flaws: Every mistake in the table, one line each.
    """

    def __init__(self, flaws: Iterable[str]) -> None:
        self.flaws = tuple(flaws)
        super().__init__("; ".join(self.flaws))


@dataclass(frozen=True)
class StateTable:
    """A state table as read from its file.

    Attributes:
        start: Initial state.
        patience_s: Time in one state after which the condition `late` is yes, s.
        configs: Dictionary from row numbers to rows. Rows with formal mistakes are left out.
        plan: The level's record of `[plan]`. None if it has mistakes.
        checksum: CRC-32 of the file.
        flaws: Formal mistakes of the file, one line each.
    """

    start: str
    patience_s: float
    configs: Mapping[int, RowConfig]
    plan: Any
    checksum: int
    flaws: tuple[str, ...]

    @cached_property
    def rows(self) -> Mapping[str, Mapping[int, RowConfig]]:
        """Dictionary from each state to its rows, which are keyed by number and in file order."""
        rows: dict[str, dict[int, RowConfig]] = {}
        for number, row in self.configs.items():
            for state in row.state:
                rows.setdefault(state, {})[number] = row
        return rows

    def choose_row(self, state: str, values: Mapping[str, str]) -> tuple[int, RowConfig]:
        """Return the number of the row that fires, and the row.

        If no row matches, the number is 0 and the row reports an error. This cannot happen in a
        table that passed the check.
        """
        for number, row in self.rows.get(state, {}).items():
            if row.matches_case(values):
                return number, row
        case = ", ".join(f"{name} = {value}" for name, value in values.items())
        reason = f"no row of '{state}' takes {case}"
        return 0, RowConfig.model_construct(name="", state=(state,), next=state, reason=reason)


def read_table(path: Path, vocabulary: Vocabulary) -> StateTable:
    """Read a table from a file without checking its words and states.

    Raises:
        TableError: If the file cannot be read, is not TOML, or lacks the keys of a table.
    """
    try:
        data = read_regular_file(path, MAX_FILE_BYTES)
        config = TableConfig.model_validate(load_toml(data.decode()))
    except OSError as error:
        raise TableError([f"cannot be read: {error.strerror}"]) from error
    except ValidationError as error:
        raise TableError(_format_validation_errors(error, "", TableConfig)) from error
    except ValueError as error:  # TOML, UTF-8
        raise TableError([f"not TOML: {error}"]) from error
    configs = {}
    flaws = list[str]()
    plan = None
    for number, row in enumerate(config.row, 1):
        try:
            configs[number] = RowConfig.model_validate(row)
        except ValidationError as error:
            flaws += _format_validation_errors(error, f"row {number}: ", RowConfig)
    try:
        plan = vocabulary.plan.model_validate(config.plan)
    except ValidationError as error:
        flaws += _format_validation_errors(error, "plan: ", vocabulary.plan)
    return StateTable(config.start, config.patience, configs, plan, zlib.crc32(data), tuple(flaws))


def _format_validation_errors(error: ValidationError, place: str, kind: type[Table]) -> list[str]:
    """Format the mistakes in one table of a file.

    Args:
        error: Mistakes that pydantic found.
        place: Prefix of every line, such as "row 3: ".
        kind: Record class of the table, which lists the known keys.

    Returns:
        One line for each mistake.
    """
    known = ", ".join(field.alias or key for key, field in kind.model_fields.items())
    lines = []
    for entry in error.errors(include_url=False):
        key = ".".join(str(key_part) for key_part in entry["loc"])
        message = entry["msg"]
        why = f"{str(entry['input'])[:40]!r}: {message[0].lower()}{message[1:]}"
        if entry["type"] == "missing":
            why = "missing"
        elif entry["type"] == "extra_forbidden":
            why = f"unknown key; known: {known}"
        lines.append(f"{place}{key}: {why}")
    return lines
