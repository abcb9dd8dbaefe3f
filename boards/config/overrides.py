"""`--set key.sub=value`: single values of a config from the command line."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from typing import Any

from rack.boards.config.files import DEEPEST, Tables, merge, parse
from rack.boards.errors import ConfigError, Mistake, shown

PART = r"""(?:"(?:[^"\\]|\\.)*"|'[^']*'|[^."'=\s]+)"""
SETTING = re.compile(rf"\s*({PART}(?:\s*\.\s*{PART})*)\s*=(.*)", re.DOTALL)
""""key.sub=value"; a key that holds a dot stands in quotes, as in TOML: protocol.mailbox."level.plan"=lock."""


def override(tables: Tables, settings: Sequence[str]) -> Tables:
    """Return the tables with each setting `key.sub=value` applied, in order.

    Values are TOML; text that is no TOML value is taken as a string. A number in a key is a place in a list,
    as in `task.action.0.by=30`. Raises `ConfigError`.
    """
    mistakes: list[Mistake] = []
    for setting in settings:
        try:
            keys, value = _parts(setting)
            tables = _put(tables, keys, value)
        except LookupError as error:
            mistakes.append(Mistake("--set", setting, str(error.args[0])))
        except ConfigError as error:
            mistakes += [Mistake("--set", setting, mistake.why) for mistake in error.mistakes]
    if mistakes:
        raise ConfigError(mistakes)
    return tables


def _parts(setting: str) -> tuple[list[str], Any]:
    """Return the keys and the value of a setting. Raises `LookupError` and `ConfigError`."""
    found = SETTING.fullmatch(setting)
    if found is None or "\0" in setting:
        raise LookupError("must be key=value, as in clock.speed=2")
    keys = [_key(part) for part in re.findall(PART, found[1])]
    if len(keys) > DEEPEST:
        raise LookupError(f"nested too deep; permitted: {DEEPEST} levels")
    return keys, _value(found[2])


def _key(part: str) -> str:
    if part[0] not in "\"'":
        return part
    try:
        return str(tomllib.loads(f"key = {part}")["key"])
    except tomllib.TOMLDecodeError as error:
        raise LookupError(f"{part} is no key: {error}") from None


def _value(text: str) -> Any:
    try:
        tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text.strip()
    except (RecursionError, ValueError):
        pass  # TOML, but out of bounds
    return parse(f"value = {text}")["value"]


def _put(node: Any, keys: list[str], value: Any) -> Any:
    """Return a copy of `node` with `value` at `keys`. Raises `LookupError` with a reason."""
    if not keys:
        return merge(node, value) if isinstance(node, dict) and isinstance(value, dict) else value
    key, *rest = keys
    if isinstance(node, list):
        if key not in map(str, range(len(node))):
            raise LookupError(f"{shown(key)} is no place in a list of {len(node)}")
        return [_put(item, rest, value) if place == int(key) else item for place, item in enumerate(node)]
    if not isinstance(node, dict):
        raise LookupError(f"{shown(key)} would stand in {shown(node)}, which is no table")
    return {**node, key: _put(node.get(key, {} if rest else None), rest, value)}
