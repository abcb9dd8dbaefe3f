"""The words of a level's state tables: conditions, commands that it accepts, actions.

A level's class declares them; a table, a TOML file, combines them. Every set of words is finite, so
whether two rows overlap, and which case no row takes, can be decided exactly.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

from rack.levels.tables import Table

NAME_BYTES = 24
"""Longest word, name of a state, or name of a table."""
PHRASE_BYTES = 64
"""Longest command or action, with its parameters."""
TAKE = "take"
"""The action of every level: from now on the newest command is the one in force, and the status
answers it."""


class Condition(NamedTuple):
    """What a row may ask for."""

    values: tuple[str, ...]  # it always has exactly one of them
    meaning: str


class Phrase(NamedTuple):
    """A command that a level accepts, or an action: a word, and the words that may follow it."""

    parameters: tuple[
        str | tuple[str, ...], ...
    ]  # one set of words each; a name stands for a set of `Lexicon`
    meaning: str


Lexicon = Mapping[str, Sequence[str]]
"""Sets of words that depend on scene and plan, by name: "object" -> the objects of the scene."""


class NoPlan(Table):
    """The `[plan]` of a level that has none."""


@dataclass(frozen=True)
class Vocabulary:
    """All words of one kind of level. `plan` is the record of `[plan]`, the static plan in the file
    of a table."""

    conditions: Mapping[str, Condition]
    commands: Mapping[str, Phrase]
    actions: Mapping[str, Phrase]
    plan: type[Table] = NoPlan


def phrases(verbs: Mapping[str, Phrase], lexicon: Lexicon) -> Iterator[str]:
    """Yield every command or action with its parameters: "pick block1"."""
    for word, verb in verbs.items():
        for parameters in product(*(_words(parameter, lexicon) for parameter in verb.parameters)):
            yield " ".join((word, *parameters))


def _words(parameter: str | tuple[str, ...], lexicon: Lexicon) -> Sequence[str]:
    return lexicon[parameter] if isinstance(parameter, str) else parameter


def objection(phrase: str, verbs: Mapping[str, Phrase], lexicon: Lexicon) -> str:
    """Return why `phrase` is none of the commands or actions; empty: it is one."""
    if len(phrase) > PHRASE_BYTES:
        return f"'{phrase}' has {len(phrase)} characters; permitted: {PHRASE_BYTES}"
    word, *given = phrase.split() or [""]
    if word not in verbs:
        return f"unknown '{word}'; known: {', '.join(verbs) or 'none'}"
    wanted = verbs[word].parameters
    if len(given) != len(wanted):
        return f"'{phrase}' has {len(given)} parameters; '{word}' takes {len(wanted)}"
    for value, parameter in zip(given, wanted, strict=True):
        permitted = _words(parameter, lexicon)
        if value not in permitted:
            return f"'{value}' of '{phrase}' is unknown; known: {', '.join(permitted) or 'none'}"
    return ""
