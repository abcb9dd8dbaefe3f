"""Loading of configs: reads files and settings, and validates each table.

`rack.boards.config.resolved` checks the tables against each other. It also runs here if a table
has mistakes, so that all mistakes are reported at once.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from rack.boards.config.command import CommandConfig
from rack.boards.config.files import CONFIGS, Assembled, assemble, resolve_paths
from rack.boards.config.mistakes import convert_errors
from rack.boards.config.resolved import Examination
from rack.boards.config.schema import LAST_SLOT, RackConfig
from rack.boards.config.toml import Tables, find_table_name, parse_tables, remove_tables
from rack.boards.errors import ConfigError, Mistake
from rack.boards.faults.config import FaultConfig
from rack.levels.errors import RobotError
from rack.levels.tables import Table

T = TypeVar("T", bound=Table)


def load(
    name_or_path: str | Path, overrides: Sequence[str] = (), faults: str | Path | None = None
) -> RackConfig:
    """Load a config and add the folders of its levels to the import path.

    Each table is checked separately. `resolve` checks whether the tables fit together.

    Args:
        name_or_path: Name of a bundled config, or path of a TOML file.
        overrides: Settings `key.sub=value`, applied in order. Paths in them are relative to the
            current folder.
        faults: Name or path of a fault script, whose faults are appended to the config's own.

    Raises:
        ConfigError: A file, a setting or a table is wrong. All mistakes are listed.
    """
    return validate(assemble(name_or_path, overrides, faults))


def load_text(text: str) -> RackConfig:
    """Load a config from TOML text that `RackConfig.to_toml_text` wrote.

    Like `load`, this extends the import path. Raises `ConfigError` with all mistakes.
    """
    return validate(Assembled(resolve_paths(parse_tables(text), CONFIGS)))


def read_stored(text: str) -> RackConfig:
    """Read the stored config of a rack or a run. The text may come from an untrusted source.

    This imports no module that the config names and does not change the import path.

    Raises:
        ConfigError: A table is wrong. All mistakes are listed.
    """
    tables = resolve_paths(parse_tables(text), CONFIGS)
    try:
        return _complete_robot(RackConfig.model_validate(tables))
    except ValidationError as error:
        raise ConfigError(convert_errors(error, RackConfig, tables)) from None


def extend_path(folders: Sequence[Path]) -> None:
    """Append folders to Python's import path, except those that it already contains."""
    sys.path += [str(folder) for folder in folders if str(folder) not in sys.path]


def validate(assembly: Assembled) -> RackConfig:
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
        found = convert_errors(error, RackConfig, tables)
        broken |= {find_table_name(mistake.place) for mistake in found}
        mistakes += [
            mistake
            for mistake in found
            # Do not report a missing key that an unreadable file or setting may contain.
            if not mistake.why.startswith("missing")
            or (assembly.is_whole and find_table_name(mistake.place) not in assembly.broken)
        ]
    if not assembly.is_whole:
        raise ConfigError(mistakes)
    if broken:
        config = _build_valid_part(tables, broken)
    extend_path(config.python_path)
    try:
        config = _complete_robot(config)
    except ConfigError as error:
        broken |= {"robot"}
        mistakes += error.mistakes
        config = _build_valid_part(tables, broken)
    if not mistakes:
        return config
    faults = _iterate_valid_tables(tables, "fault", FaultConfig)
    commands = _iterate_valid_tables(tables, "command", CommandConfig)
    raise ConfigError([*mistakes, *Examination(config, faults, commands, broken).mistakes])


def _iterate_valid_tables(tables: Tables, key: str, kind: type[T]) -> Iterator[tuple[str, T]]:
    """Yield each valid entry of the list `key`, preceded by its place, as in "fault[0]".

    Invalid entries are left out, because their mistakes are already reported.
    """
    entries = tables.get(key)
    for at, entry in enumerate(entries if isinstance(entries, list) else ()):
        with suppress(ValidationError):
            yield f"{key}[{at}]", kind.model_validate(entry)


def _build_valid_part(tables: Tables, broken: frozenset[str]) -> RackConfig:
    """Return a config that consists of the tables without mistakes."""
    valid = remove_tables(
        {key: tables[key] for key in RackConfig.model_fields if key in tables}, broken
    )
    # Placeholders for required tables: nothing that depends on a broken table is checked.
    required = {"name": "unnamed", "clock": {"period_ms": 1}}
    board = {"unnamed": {"slot": LAST_SLOT, "every": 1, "executor": "unnamed:Unnamed"}}
    config = RackConfig.model_validate({**required, **valid, "board": valid["board"] or board})
    return config if valid["board"] else config.model_copy(update={"board": {}})


def _complete_robot(config: RackConfig) -> RackConfig:
    """Return the config, in which the arm's joints, tool and home come from its model if not given.

    Raises:
        ConfigError: The model does not define them.
    """
    robot = config.robot
    if robot is None or (robot.joints and robot.tool and robot.home):
        return config
    from rack.levels.robot.lookup import derive_robot

    try:
        return config.model_copy(update={"robot": derive_robot(robot)})
    except RobotError as error:
        raise ConfigError([Mistake("robot", None, str(error))]) from None
