"""The mistakes of a config, by its name, its file, or its text."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rack.boards.config import RackConfig, load, resolve
from rack.boards.config.files import Assembled
from rack.boards.config.loader import validate
from rack.boards.config.toml import apply_settings, parse_tables
from rack.boards.errors import ConfigError, Mistake


def read_config(
    config: str | Path, settings: Sequence[str], faults: str | Path | None = None
) -> RackConfig:
    """Return the config of a name, a file, or a text of several lines."""
    if "\n" not in str(config):
        return load(config, settings, faults)
    return validate(Assembled(apply_settings(parse_tables(str(config)), settings, [])))


def list_mistakes(
    config: str | Path, *settings: str, faults: str | Path | None = None
) -> list[Mistake]:
    """Return all mistakes of a config with these settings; of a valid one none."""
    try:
        resolve(read_config(config, settings, faults))
    except ConfigError as error:
        return error.mistakes
    return []


def find_mistakes(
    config: str | Path, *settings: str, faults: str | Path | None = None
) -> list[Mistake]:
    """Return all mistakes of a config that is not valid with these settings."""
    found = list_mistakes(config, *settings, faults=faults)
    assert found
    return found


def find_mistake(config: str | Path, *settings: str) -> str:
    """Return the only mistake of a config, as its line."""
    (mistake,) = find_mistakes(config, *settings)
    assert str(mistake).isprintable()
    return str(mistake)


def find_lines(config: str | Path, *settings: str, faults: str | Path | None = None) -> list[str]:
    """Return all mistakes of a config, a line each."""
    return [*map(str, find_mistakes(config, *settings, faults=faults))]
