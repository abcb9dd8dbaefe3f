"""A resolved config as TOML text: written to the segment and to the run's folder, it loads again by itself."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rack.boards.config.files import CONFIGS

BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def to_toml(tables: Mapping[str, Any]) -> str:
    """Return tables as TOML, empty ones left out."""
    return "\n".join(_lines(tables, ())).lstrip("\n") + "\n"


def portable(model: Path) -> str:
    """Return a model as a config names it: a bundled one as in configs/."""
    return model.relative_to(CONFIGS).as_posix() if model.is_relative_to(CONFIGS) else str(model)


def _lines(table: Mapping[str, Any], path: tuple[str, ...]) -> Iterator[str]:
    """Yield a table's values, then its tables: TOML would count a value behind a table as that table's."""
    kept = {key: value for key, value in table.items() if value not in ({}, [])}
    for key, value in kept.items():
        if not isinstance(value, Mapping) and not _is_tables(value):
            yield f"{_key(key)} = {_value(value)}"
    for key, value in kept.items():
        inner = (*path, key)
        name = ".".join(_key(part) for part in inner)
        if isinstance(value, Mapping):
            # A table of nothing but tables needs no heading of its own.
            if not all(isinstance(item, Mapping) or _is_tables(item) for item in value.values()):
                yield from ("", f"[{name}]")
            yield from _lines(value, inner)
        elif _is_tables(value):
            for item in value:
                yield from ("", f"[[{name}]]", *_lines(item, inner))


def _is_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(item, Mapping) for item in value)


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_value(item) for item in value)}]"
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{_key(key)} = {_value(item)}' for key, item in value.items())} }}"
    if isinstance(value, float):
        return repr(value)
    # JSON's booleans, integers and escaped strings are TOML's too.
    return json.dumps(value, ensure_ascii=False, default=str)


def _key(key: str) -> str:
    return key if BARE_KEY.fullmatch(key) else json.dumps(key, ensure_ascii=False)
