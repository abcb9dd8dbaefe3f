"""Loading of configs: reads files and settings, and validates each table.

`rack.boards.config.resolved` checks the tables against each other. It also runs here if a table
has mistakes, so that all mistakes are reported at once.
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
    """Load a config and add the folders of its levels to the import path.

    This checks each table alone. `resolve` checks the tables against each other.

    Args:
        name_or_path: Name of a bundled config, or path of a TOML file.
        overrides: Settings `key.sub=value`, applied in order. Paths in them are relative to the
            current folder.
        faults: Name or path of a fault script, whose faults are appended to the config's own.

    Raises:
        ConfigError: A file, a setting or a table is wrong. All mistakes are listed.
    """
    return validated(assembled(name_or_path, overrides, faults))


def loads(text: str) -> RackConfig:
    """Load a config from TOML text, as `RackConfig.to_toml_text` writes it.

    Like `load`, this extends the import path and raises `ConfigError` with every mistake.
    """
    return validated(Assembled(anchor(parse(text), CONFIGS)))


def read_stored(text: str) -> RackConfig:
    """Read the config that a rack or a run stores as text, which may not be trusted.

    Nothing that the config names is imported, and the import path stays as it is.

    Raises:
        ConfigError: A table is wrong. All mistakes are listed.
    """
    tables = anchor(parse(text), CONFIGS)
    try:
        return _with_derived(RackConfig.model_validate(tables))
    except ValidationError as error:
        raise ConfigError(mistakes_of(error, RackConfig, tables)) from None


def validated(assembly: Assembled) -> RackConfig:
    """Validate the tables of a config, and add the folders of its levels to the import path.

    Raises:
        ConfigError: The config has mistakes. Later checks still run on the valid tables, so that
            all mistakes are listed.
    """
    tables = assembly.tables
    mistakes = list(assembly.mistakes)
    broken = assembly.broken
    try:
        config = RackConfig.model_validate(tables)
    except ValidationError as error:
        broken |= _broken(error)
        mistakes += [
            mistake
            for mistake in mistakes_of(error, RackConfig, tables)
            # A missing key may be in a file or setting that could not be read.
            if not mistake.why.startswith("missing")
            or (assembly.is_whole and table_of(mistake.place) not in assembly.broken)
        ]
    if not assembly.is_whole:
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
    """Yield place and record of each valid table of a list. Invalid ones are already reported."""
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
    """Return a config that consists of the tables without mistakes."""
    valid = without({key: tables[key] for key in RackConfig.model_fields if key in tables}, broken)
    # Placeholders for required tables: nothing that depends on a broken table is checked.
    required = {"name": "unnamed", "clock": {"period_ms": 1}}
    board = {"unnamed": {"slot": LAST_SLOT, "every": 1, "executor": "unnamed:Unnamed"}}
    config = RackConfig.model_validate({**required, **valid, "board": valid["board"] or board})
    return config if valid["board"] else config.model_copy(update={"board": {}})


def _with_derived(config: RackConfig) -> RackConfig:
    """Return the config with joints, tool and home of the arm taken from its model if not given.

    Raises:
        ConfigError: The model does not provide them.
    """
    robot = config.robot
    if robot is None or (robot.joints and robot.tool and robot.home):
        return config
    from rack.levels.robot.lookup import derived

    try:
        return config.model_copy(update={"robot": derived(robot)})
    except RobotError as error:
        raise ConfigError([Mistake("robot", None, str(error))]) from None
