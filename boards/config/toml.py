"""TOML text: parsing within limits, changes by `--set key.sub=value`, and writing."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

import tomli_w

from rack.backplane.bounded_toml import INTEGER_BITS, MAX_DEPTH, TOO_DEEP, TOO_LONG, load_toml
from rack.boards.errors import ConfigError, Mistake, format_value

SETTING = re.compile(r"""((?:"(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[^"'=\n])+)=([^\0]*)""")
"""Pattern of a setting "key.sub=value" with a TOML key: `protocol.mailbox."level.plan"=lock`."""
FREE_FORM = ("params", "task")
"""Tables that levels declare. An empty list in them is a value and must be written."""

Tables = dict[str, Any]


def parse_tables(text: str, place: str = "config") -> Tables:
    """Parse TOML text.

    Raises:
        ConfigError: The text is not TOML, or contains values that configs must not contain, such
            as dates, very long integers and very deep nesting. All such values are listed.
    """
    try:
        tables = load_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError([Mistake(place, None, f"not TOML: {error}")]) from None
    except ValueError as error:
        raise ConfigError([Mistake(place, None, str(error))]) from None
    checks = (
        _find_values_out_of_bounds(f"{place}: {key}", value, 1) for key, value in tables.items()
    )
    if mistakes := list(chain.from_iterable(checks)):
        raise ConfigError(mistakes)
    return tables


def _find_values_out_of_bounds(where: str, value: Any, depth: int) -> Iterator[Mistake]:
    """Yield a mistake for each value that TOML permits but configs do not, such as a date."""
    if isinstance(value, dict | list) and depth >= MAX_DEPTH:
        yield Mistake(where, None, TOO_DEEP)
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _find_values_out_of_bounds(f"{where}.{key}", item, depth + 1)
    elif isinstance(value, list):
        for at, item in enumerate(value):
            yield from _find_values_out_of_bounds(f"{where}[{at}]", item, depth + 1)
    elif isinstance(value, int) and value.bit_length() >= INTEGER_BITS:
        yield Mistake(where, value, TOO_LONG)
    elif isinstance(value, str) and "\0" in value:
        yield Mistake(where, value, "text must not contain NUL")
    elif not isinstance(value, str | int | float):
        why = "dates and times are not permitted; use a number or quoted text"
        yield Mistake(where, str(value), why)


def to_toml(tables: Mapping[str, Any]) -> str:
    """Return tables as TOML text. Empty tables and lists are left out."""
    return tomli_w.dumps(_drop_empty_values(tables))


def _drop_empty_values(value: Any) -> Any:
    """Return a copy of a value in which tables, also inside lists, have no empty values.

    Tables in `FREE_FORM` are kept unchanged.
    """
    if isinstance(value, list | tuple):
        return [_drop_empty_values(item) for item in value]
    if not isinstance(value, Mapping):
        return value
    return {
        key: item if key in FREE_FORM else _drop_empty_values(item)
        for key, item in value.items()
        if item not in ({}, [], ())
    }


def merge_tables(base: Tables, top: Tables) -> Tables:
    """Return `base` updated with `top`. Tables that both contain are merged recursively."""
    merged = dict(base)
    for key, value in top.items():
        is_table = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = merge_tables(base[key], value) if is_table else value
    return merged


def apply_settings(tables: Tables, settings: Sequence[str], mistakes: list[Mistake]) -> Tables:
    """Return a copy of tables with settings `key.sub=value` applied in order.

    A value is parsed as TOML. If it is not TOML, it is a string. A number in a key is an index into
    a list, as in `task.action.0.by=30`.

    Args:
        tables: Tables of a config.
        settings: The settings.
        mistakes: List to which mistakes are added. Settings with a mistake are not applied.
    """
    for setting in settings:
        try:
            keys, text = _split_setting(setting)
            tables = _set_value(tables, keys, _parse_value(text))
        except LookupError as error:
            mistakes.append(Mistake("--set", setting, str(error.args[0])))
        except ConfigError as error:
            mistakes += [Mistake("--set", setting, mistake.why) for mistake in error.mistakes]
    return tables


def _split_setting(setting: str) -> tuple[list[str], str]:
    """Split `key.sub=value` into its keys and the text of its value.

    Raises `LookupError` if the setting does not have this form.
    """
    match = SETTING.fullmatch(setting)
    keys: list[str] = []
    try:
        node: Any = load_toml(f"{match[1]} = 0") if match else 0
    except tomllib.TOMLDecodeError:
        node = 0
    except ValueError as error:
        raise LookupError(str(error)) from None
    while isinstance(node, dict):
        ((key, node),) = node.items()
        keys.append(key)
    if match is None or not keys:
        raise LookupError("must be key=value, as in clock.speed=2")
    return keys, match[2]


def _parse_value(text: str) -> Any:
    """Parse a TOML value. Return the stripped text itself if it is not TOML.

    Raises `ConfigError` if configs must not contain the value.
    """
    try:
        load_toml(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text.strip()
    except ValueError:
        # `parse_tables` raises `ConfigError` with the reason why the value is refused.
        pass
    return parse_tables(f"value = {text}")["value"]


def _set_value(node: Any, keys: list[str], value: Any) -> Any:
    """Return a copy of `node` with `value` set at `keys`.

    Raises `LookupError` for a wrong list index, or for a key in a value that is not a table.
    """
    if not keys:
        return (
            merge_tables(node, value)
            if isinstance(node, dict) and isinstance(value, dict)
            else value
        )
    key, *rest = keys
    if isinstance(node, list):
        if key not in map(str, range(len(node))):
            raise LookupError(f"{format_value(key)} is not an index of a list of {len(node)}")
        items = list(node)
        items[int(key)] = _set_value(items[int(key)], rest, value)
        return items
    if not isinstance(node, dict):
        raise LookupError(
            f"{format_value(key)} cannot be set in {format_value(node)}, which is not a table"
        )
    empty: Tables | None = {} if rest else None
    return {**node, key: _set_value(node.get(key, empty), rest, value)}


def find_table_name(place: str) -> str:
    """Return the table that contains a place, as "board.servo" for "board.servo.rate_hz"."""
    kind, *name = re.split(r"[.\[=]", place.replace("mailbox ", "board."))[:2]
    return f"{kind}.{name[0]}" if name and kind in ("board", "host") else kind


def remove_tables(tables: Tables, broken: frozenset[str]) -> Tables:
    """Return tables without those that `broken` names, as in "robot" or "board.servo"."""
    remaining = {key: value for key, value in tables.items() if key not in broken}
    for key in ("board", "host"):
        # For a name with a dot, as in board."a.b", `broken` contains only "board.a".
        remaining[key] = {
            name: table
            for name, table in remaining.get(key, {}).items()
            if find_table_name(f"{key}.{name}") not in broken
        }
    return remaining
