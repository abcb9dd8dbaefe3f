"""What pydantic finds wrong with a table, as mistakes: place, value, and what is permitted."""

from __future__ import annotations

import difflib
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from rack.boards.errors import Mistake

ALONE = {"robot": "; a [robot] that names its model is another arm, and takes nothing from a file that it extends"}
"""What to know of a table that misses something, by its key."""


def mistakes_of(error: ValidationError, model: type[BaseModel], tables: Any, place: str = "") -> list[Mistake]:
    """Return the mistakes of `tables`, which stand at `place` in the config and failed as a `model`."""
    found = [_mistake(entry, model, tables, place) for entry in error.errors(include_url=False)]
    # A value that may be of several kinds is none of them by one mistake each: the first will do, or that of its item.
    first = {mistake.place: mistake for mistake in reversed(found)}
    within = {place for place in first if any(other.startswith((f"{place}[", f"{place}.")) for other in first)}
    return [first[place] for place in reversed(first) if place not in within]


def _mistake(entry: ErrorDetails, model: type[BaseModel], tables: Any, place: str) -> Mistake:
    keys = _keys(entry["loc"], tables)
    where = (place + "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys)).lstrip(".")
    owner, field = _declared(model, keys)
    meaning = f"; {field.description}" if field is not None and field.description else ""
    if entry["type"] == "missing":
        return Mistake(where, None, f"missing{meaning}{ALONE.get(str(keys[0]), '')}")
    if entry["type"] == "extra_forbidden":
        return Mistake(where, entry["input"], _unknown(str(keys[-1]), owner))
    text = entry["msg"].removeprefix("Value error, ").removeprefix("Input ").replace("valid tuple", "list")
    return Mistake(where, entry["input"], f"{text}{meaning}")


def _keys(loc: tuple[int | str, ...], table: Any) -> list[int | str]:
    """Return the keys of a location that stand in the table: pydantic puts the names of variants between."""
    keys: list[int | str] = []
    for place, key in enumerate(loc):
        is_last = place == len(loc) - 1
        in_list = isinstance(table, list) and isinstance(key, int) and key < len(table)
        if in_list or (isinstance(table, dict) and key in table):
            table = table[key]
            keys.append(key)
        elif is_last and isinstance(table, dict):
            keys.append(key)
    return keys


def _declared(model: type[BaseModel], keys: list[int | str]) -> tuple[type[BaseModel] | None, FieldInfo | None]:
    """Return the table and the field of the schema that `keys` lead to."""
    table: type[BaseModel] | None = model
    owner, field, is_name = table, None, False
    for key in keys:
        if isinstance(key, int):
            continue
        if is_name:  # the name of a table among tables of one kind, as in [board.servo]
            is_name = False
            continue
        owner, field = table, _field(table, key) if table is not None else None
        table, is_name = _table(field), field is not None and get_origin(field.annotation) is dict
    return owner, field


def _field(table: type[BaseModel], key: str) -> FieldInfo | None:
    return next((field for name, field in table.model_fields.items() if key == (field.alias or name)), None)


def _table(field: FieldInfo | None) -> type[BaseModel] | None:
    kinds = [field.annotation, *get_args(field.annotation)] if field is not None else []
    return next((kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)), None)


def _unknown(key: str, owner: type[BaseModel] | None) -> str:
    known = [field.alias or name for name, field in owner.model_fields.items()] if owner is not None else []
    near = difflib.get_close_matches(key, known, 1)
    return f"unknown key; did you mean '{near[0]}'?" if near else f"unknown key; known: {', '.join(known)}"
