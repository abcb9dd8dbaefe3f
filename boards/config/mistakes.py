"""Mistakes within a single table, as pydantic finds them.

The rules in `rack.boards.config.rules` find the mistakes between tables.
"""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from rack.boards.errors import Mistake
from rack.levels.tables import describe_keys

HINTS = {
    "robot": (
        "; a [robot] with its own model is a different arm and inherits nothing from extended files"
    )
}
"""Hints by table, for an error about a missing key."""


def convert_errors(
    error: ValidationError, model: type[BaseModel], tables: Any, place: str = ""
) -> list[Mistake]:
    """Convert a validation error of pydantic into mistakes.

    Args:
        error: The error.
        model: The model against which the tables were validated.
        tables: The tables.
        place: Place of the tables in the config. Empty for the whole config.
    """
    reports = [
        _convert_error(entry, model, tables, place) for entry in error.errors(include_url=False)
    ]
    # pydantic reports a value of a union once for each member type. Keep the first report for each
    # place, and drop a report about a container if another report is about a value inside it.
    first = {mistake.place: mistake for mistake in reversed(reports)}
    within = {
        place
        for place in first
        if any(other.startswith((f"{place}[", f"{place}.")) for other in first)
    }
    return [first[place] for place in reversed(first) if place not in within]


def _convert_error(entry: ErrorDetails, model: type[BaseModel], tables: Any, place: str) -> Mistake:
    """Convert one error of pydantic into a mistake. See `convert_errors` for the arguments."""
    keys = _drop_variant_names(entry["loc"], tables, entry["type"] == "missing")
    where = (
        place + "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys)
    ).lstrip(".")
    # The value of one key, the discriminator, should select the model of the table.
    if entry["type"].startswith("union_tag"):
        context = entry["ctx"]
        valid = context.get("expected_tags", "").replace("'", "")
        why = f"valid values: {valid}" if valid else "missing; it selects the kind of table"
        # pydantic puts the name of the key in quotes.
        return Mistake(f"{where}.{context['discriminator'][1:-1]}", context.get("tag"), why)
    known, field = _find_declaration(model, keys, tables)
    meaning = f"; {field.description}" if field is not None and field.description else ""
    if entry["type"] == "missing":
        return Mistake(where, None, f"missing{meaning}{HINTS.get(str(keys[0]), '')}")
    if entry["type"] == "extra_forbidden":
        near = difflib.get_close_matches(str(keys[-1]), known, 1)
        why = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
        return Mistake(where, entry["input"], f"unknown key; {why}")
    text = (
        entry["msg"]
        .removeprefix("Value error, ")
        .removeprefix("Input ")
        .replace("valid tuple", "list")
    )
    if entry["type"] == "value_error" and isinstance(entry["input"], dict):
        return Mistake(where, None, text)
    return Mistake(where, entry["input"], f"{text}{meaning}")


def _drop_variant_names(
    loc: tuple[int | str, ...], table: Any, is_missing: bool
) -> list[int | str]:
    """Return the keys in an error's location, without the names of union members in it.

    Args:
        loc: The location, into which pydantic inserts these names.
        table: The validated table, which shows which entries of `loc` are keys.
        is_missing: Whether the last key is missing from the table.
    """
    keys: list[int | str] = []
    for key in loc:
        in_list = isinstance(table, list) and isinstance(key, int) and key < len(table)
        if in_list or (isinstance(table, dict) and key in table):
            table = table[key]
            keys.append(key)
    return [*keys, loc[-1]] if is_missing else keys


def _find_declaration(
    model: type[BaseModel], keys: list[int | str], table: Any
) -> tuple[list[str], FieldInfo | None]:
    """Look up the declaration of a key in a model.

    Args:
        model: The model of the whole table.
        keys: Keys that lead to the key.
        table: The table.

    Returns:
        All valid keys of the innermost table, and the field of the key. None if it is unknown.
    """
    models = [model]
    known = dict[str, FieldInfo]()
    field = None
    is_name = False
    for key in keys:
        models = [kind for kind in models if _matches_fixed_values(kind, table)] or models
        try:
            table = table[key]
        except (LookupError, TypeError):
            # The key is missing, or its parent is not a table.
            table = None
        if isinstance(key, int):
            continue
        if is_name:
            # This key is a name that the user chose, as "servo" in [board.servo].
            is_name = False
            continue
        known = {name: f for kind in models for name, f in describe_keys(kind).items()}
        field = known.get(key)
        models = list(_list_models(field.annotation)) if field is not None else []
        is_name = field is not None and get_origin(field.annotation) is dict
    return list(known), field


def _matches_fixed_values(kind: type[BaseModel], table: Any) -> bool:
    """Return True if a table has the literal values that a model requires, as in do = "goto"."""
    fixed = {
        key: get_args(f.annotation)
        for key, f in kind.model_fields.items()
        if get_origin(f.annotation) is Literal
    }
    return isinstance(table, dict) and all(
        table.get(key) in values for key, values in fixed.items()
    )


def _list_models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models within a type annotation such as `tuple[Transfer | Goto, ...]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for member in get_args(annotation):
        yield from _list_models(member)


def report_repeated_names(place: str, names: Iterable[str]) -> Iterator[Mistake]:
    """Yield a mistake for every name that is listed more than once."""
    for name, count in count_repeated_names(names):
        yield Mistake(place, name, f"listed {count} times")


def count_repeated_names(names: Iterable[str]) -> Iterator[tuple[str, int]]:
    """Yield each repeated name and the number of its occurrences."""
    return ((name, count) for name, count in Counter(names).items() if count > 1)


def format_place(place: str, key: str) -> str:
    """Return the place of a key in a table, as in "fault[0].tick".

    Args:
        place: Place of the table. "" for a live command or fault.
        key: The key.
    """
    return f"{place}.{key}" if place else key
