"""From files, or text, to a config: `load` and `loads`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from rack.boards.config.classes import extend_path
from rack.boards.config.files import CONFIGS, Tables, anchor, parse, read, with_faults
from rack.boards.config.overrides import override
from rack.boards.config.rules import mistakes_in
from rack.boards.config.schema import LAST_SLOT, RackConfig
from rack.boards.config.schema_mistakes import mistakes_of
from rack.boards.config.wiring import judged
from rack.boards.errors import ConfigError, Mistake
from rack.boards.faults.config import FaultConfig
from rack.boards.operating.config import CommandConfig
from rack.levels.tables import Table

T = TypeVar("T", bound=Table)


def load(name_or_path: str | Path, overrides: Sequence[str] = (), faults: str | Path | None = None) -> RackConfig:
    """Return the config of that name or in that file, with `key.sub=value` overrides.

    The faults of the script `faults`, by name or path, come behind its own. Paths in an override are relative to the
    current folder. Raises `ConfigError` with every mistake.
    """
    tables = read(name_or_path)
    if faults is not None:
        tables = with_faults(tables, faults)
    return resolve(anchor(override(tables, overrides), Path.cwd()))


def loads(text: str) -> RackConfig:
    """Return the config in TOML text, as `RackConfig.text` gives it. Raises `ConfigError`."""
    return resolve(anchor(parse(text), CONFIGS))


def resolve(tables: Tables) -> RackConfig:
    """Return the config that plain tables hold; its levels can be imported. Raises `ConfigError` with every mistake."""
    found: list[Mistake] = []
    broken: frozenset[str] = frozenset()
    try:
        config = RackConfig.model_validate(tables)
    except ValidationError as error:
        found, broken = mistakes_of(error, RackConfig, tables), _broken(error)
        config = _intact(tables, broken)
    extend_path(config.python_path)
    if broken or mistakes_in(config):
        faults, commands = _readable(tables, "fault", FaultConfig), _readable(tables, "command", CommandConfig)
        raise ConfigError([*found, *judged(config, faults, commands, broken)[0]])
    return config


def _readable(tables: Tables, key: str, kind: type[T]) -> Iterator[tuple[str, T]]:
    """Yield place and table for those of a list that are whole; the others' mistakes are known."""
    entries = tables.get(key)
    for at, entry in enumerate(entries if isinstance(entries, list) else []):
        with suppress(ValidationError):
            yield f"{key}[{at}]", kind.model_validate(entry)


def _broken(error: ValidationError) -> frozenset[str]:
    """Return the tables with mistakes, as "robot" or "board.servo"."""
    places = [[str(key) for key in entry["loc"]] for entry in error.errors()]
    return frozenset(".".join(keys[:2] if keys[0] == "board" else keys[:1]) for keys in places)


def _intact(tables: Tables, broken: frozenset[str]) -> RackConfig:
    """Return a config of the tables without mistakes."""
    kept = {key: value for key, value in tables.items() if key in RackConfig.model_fields and key not in broken}
    boards = {name: table for name, table in kept.get("board", {}).items() if f"board.{name}" not in broken}
    # Stand-ins for required tables; what depends on a broken table is not looked at.
    spare = {"name": "unnamed", "clock": {"period_ms": 1}}
    none = {"unnamed": {"slot": LAST_SLOT, "every": 1, "executor": "unnamed:Unnamed"}}
    config = RackConfig.model_validate({**spare, **kept, "board": boards or none})
    return config if boards else config.model_copy(update={"board": {}})
