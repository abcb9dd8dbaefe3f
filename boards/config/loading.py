"""From files, or text, to a config: `load` and `loads`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from boards.config.classes import extend_path
from boards.config.faults import fault_mistakes
from boards.config.files import CONFIGS, Tables, anchor, parse, read, with_faults
from boards.config.overrides import override
from boards.config.rules import mistakes_in
from boards.config.schema import RackConfig
from boards.config.schema_mistakes import mistakes_of
from boards.config.wiring import Wiring
from boards.errors import ConfigError, Mistake
from boards.faults.config import readable


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
    try:
        config = RackConfig.model_validate(tables)
    except ValidationError as error:
        broken = _broken(error)
        intact = _intact(tables, broken)
        rest = _mistakes(intact, broken, tables.get("fault")) if intact is not None else []
        raise ConfigError([*mistakes_of(error, RackConfig, tables), *rest]) from None
    if mistakes_in(config):
        raise ConfigError(_mistakes(config, frozenset(), tables.get("fault")))
    extend_path(config.python_path)
    return config


def _mistakes(config: RackConfig, broken: frozenset[str], faults: object) -> list[Mistake]:
    """Return everything wrong with a config, its wiring too: one run of a command shows every mistake there is."""
    extend_path(config.python_path)
    untold = frozenset(place.removeprefix("board.") for place in broken if place.startswith("board."))
    of_faults = fault_mistakes(readable(faults), config, untold=untold)
    return [*mistakes_in(config, broken), *Wiring(config, broken).mistakes, *of_faults]


def _broken(error: ValidationError) -> frozenset[str]:
    """Return the tables with mistakes, as "robot" or "board.servo"."""
    places = [[str(key) for key in entry["loc"]] for entry in error.errors()]
    return frozenset(".".join(keys[:2] if keys[0] == "board" else keys[:1]) for keys in places)


def _intact(tables: Tables, broken: frozenset[str]) -> RackConfig | None:
    """Return a config of the tables without mistakes, or None when no board is left."""
    kept = {key: value for key, value in tables.items() if key in RackConfig.model_fields and key not in broken}
    boards = {name: table for name, table in kept.get("board", {}).items() if f"board.{name}" not in broken}
    # Stand-ins for required tables; what depends on a broken table is not looked at.
    return (
        RackConfig.model_validate({"name": "unnamed", "clock": {"period_ms": 1}, **kept, "board": boards})
        if boards
        else None
    )
