"""From TOML to a config: files and settings are read, and each table is validated.

What tables must agree on is checked by `rack.boards.config.resolved`, which also runs here when a
table has mistakes, so that all mistakes are reported at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from rack.boards.classes import extend_path
from rack.boards.config.files import CONFIGS, Assembled, anchor, assembled
from rack.boards.config.mistakes import mistakes_of
from rack.boards.config.resolved import Examination
from rack.boards.config.schema import LAST_SLOT, CommandConfig, RackConfig
from rack.boards.config.toml import Tables, parse, table_of, without
from rack.boards.errors import ConfigError, Mistake
from rack.boards.faults.config import FaultConfig
from rack.levels.errors import RobotError
from rack.levels.tables import Table

T = TypeVar("T", bound=Table)


def load(
    name_or_path: str | Path, overrides: Sequence[str] = (), faults: str | Path | None = None
) -> RackConfig:
    """Return a config by name or path, with `key.sub=value` overrides, and add its levels to the
    import path.

    Faults of the script `faults`, by name or path, are appended to its own. Paths in an override
    are relative to the current folder. Raises `ConfigError` with every mistake if a file, a setting
    or a single table is wrong; `resolve` checks the rest.
    """
    return validated(assembled(name_or_path, overrides, faults))


def loads(text: str) -> RackConfig:
    """Return the config in TOML text, as `RackConfig.text` writes it, and add its levels to the
    import path. Raises `ConfigError` as `load` does.
    """
    return validated(Assembled(anchor(parse(text), CONFIGS)))


def read_stored(text: str) -> RackConfig:
    """Return the config that a rack or a run holds as text, which may be somebody else's.

    Nothing that it names is imported, and its levels do not come into the import path. Raises
    `ConfigError` with every mistake in a single table.
    """
    tables = anchor(parse(text), CONFIGS)
    try:
        return _with_derived(RackConfig.model_validate(tables))
    except ValidationError as error:
        raise ConfigError(mistakes_of(error, RackConfig, tables)) from None


def validated(found: Assembled) -> RackConfig:
    """Return the config in tables, and add its levels to the import path.

    Raises:
        ConfigError: The config has mistakes, those of its tables included. All stages run on the
            tables that are valid.
    """
    tables = found.tables
    mistakes = list(found.mistakes)
    broken = found.broken
    try:
        config = RackConfig.model_validate(tables)
    except ValidationError as error:
        broken |= _broken(error)
        mistakes += [
            mistake
            for mistake in mistakes_of(error, RackConfig, tables)
            # A setting or a file with mistakes may hold what is missing.
            if not mistake.why.startswith("missing")
            or (found.is_whole and table_of(mistake.place) not in found.broken)
        ]
    if not found.is_whole:
        raise ConfigError(mistakes)
    if broken:
        config = _intact(tables, broken)
    extend_path(config.python_path)
    try:
        config = _with_derived(config)
    except ConfigError as error:
        broken |= {"robot"}
        mistakes += error.mistakes
        config = _intact(tables, broken)
    if not mistakes:
        return config
    faults = _readable(tables, "fault", FaultConfig)
    commands = _readable(tables, "command", CommandConfig)
    raise ConfigError([*mistakes, *Examination(config, faults, commands, broken).mistakes])


def _readable(tables: Tables, key: str, kind: type[T]) -> Iterator[tuple[str, T]]:
    """Yield place and table for the valid tables of a list; the mistakes of the others are already
    known.
    """
    entries = tables.get(key)
    if not isinstance(entries, list):
        return
    for at, entry in enumerate(entries):
        with suppress(ValidationError):
            yield f"{key}[{at}]", kind.model_validate(entry)


def _broken(error: ValidationError) -> frozenset[str]:
    """Return the tables with mistakes, as "robot", "board.servo" or "host.program"."""
    places = [[str(key) for key in entry["loc"]] for entry in error.errors()]
    return frozenset(
        ".".join(keys[:2] if keys[0] in ("board", "host") else keys[:1]) for keys in places
    )


def _intact(tables: Tables, broken: frozenset[str]) -> RackConfig:
    """Return a config made of the tables without mistakes."""
    kept = without({key: tables[key] for key in RackConfig.model_fields if key in tables}, broken)
    # Stand-ins for required tables; nothing that depends on a broken table is checked.
    spare = {"name": "unnamed", "clock": {"period_ms": 1}}
    none = {"unnamed": {"slot": LAST_SLOT, "every": 1, "executor": "unnamed:Unnamed"}}
    config = RackConfig.model_validate({**spare, **kept, "board": kept["board"] or none})
    return config if kept["board"] else config.model_copy(update={"board": {}})


def _with_derived(config: RackConfig) -> RackConfig:
    """Return a config whose arm has joints, tool and home, its model's where it says nothing.
    Raises `ConfigError`.
    """
    robot = config.robot
    if robot is None or (robot.joints and robot.tool and robot.home):
        return config
    from rack.levels.robot.lookup import derived

    try:
        return config.model_copy(update={"robot": derived(robot)})
    except RobotError as error:
        raise ConfigError([Mistake("robot", None, str(error))]) from None
