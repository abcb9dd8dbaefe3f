"""`--set key.sub=value`: single values of a config from the command line."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from typing import Any

from boards.config.files import Tables, merge
from boards.errors import ConfigError, Mistake


def override(tables: Tables, settings: Sequence[str]) -> Tables:
    """Return the tables with each setting `key.sub=value` applied, in order.

    Values are TOML; text that is no TOML value is taken as a string. A number in a key is a place in a list,
    as in `task.action.0.by=30`. Raises `ConfigError`.
    """
    mistakes = []
    for setting in settings:
        key, equals, value = setting.partition("=")
        try:
            if not equals or not all(part.strip() for part in key.split(".")):
                raise LookupError("must be key=value, as in clock.speed=2")
            tables = _put(tables, [part.strip() for part in key.split(".")], _value(value))
        except LookupError as error:
            mistakes.append(Mistake("--set", setting, str(error.args[0])))
    if mistakes:
        raise ConfigError(mistakes)
    return tables


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text.strip()


def _put(node: Any, keys: list[str], value: Any) -> Any:
    """Return a copy of `node` with `value` at `keys`. Raises `LookupError` with a reason."""
    if not keys:
        return merge(node, value) if isinstance(node, dict) and isinstance(value, dict) else value
    key, *rest = keys
    if isinstance(node, list):
        if not key.isdecimal() or int(key) >= len(node):
            raise LookupError(f"'{key}' is no place in a list of {len(node)}")
        return [_put(item, rest, value) if place == int(key) else item for place, item in enumerate(node)]
    if not isinstance(node, dict):
        raise LookupError(f"'{key}' would stand in {node!r}, which is no table")
    return {**node, key: _put(node.get(key, {} if rest else None), rest, value)}
