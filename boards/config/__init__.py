"""Configs: from TOML to a rack.

- `load(name, overrides, faults)`, `loads(text)`: read and validate the tables, return a
  `RackConfig`, whose levels can be imported from now on.
- `read_stored(text)`: read the config of a rack or a run, and import nothing.
- `resolve(config)`: check and wire everything, return `Resolved`: config, layout, wiring, faults,
  commands.
- `wire(config)`: the layout alone.
- `shared_out(config)`: a line for every requested core that does not exist.
- `names()`, `CONFIGS`, `FAULTS`: the bundled configs and fault scripts.
- `budgets(config)`, `rack_timing(config, layout)`: the config in terms of the timing model.

Everything wrong with a config is a `ConfigError`, which reports all mistakes at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.exports import on_first_use

if TYPE_CHECKING:
    from rack.boards.config.files import CONFIGS, FAULTS, names
    from rack.boards.config.layout import shared_out
    from rack.boards.config.loader import load, loads, read_stored
    from rack.boards.config.resolved import Resolved, resolve, wire
    from rack.boards.config.schema import RackConfig
    from rack.boards.config.timing import budgets, rack_timing

__all__ = [
    "CONFIGS",
    "FAULTS",
    "RackConfig",
    "Resolved",
    "budgets",
    "load",
    "loads",
    "names",
    "rack_timing",
    "read_stored",
    "resolve",
    "shared_out",
    "wire",
]
_PLACES = {
    "rack.boards.config.files": ("CONFIGS", "FAULTS", "names"),
    "rack.boards.config.layout": ("shared_out",),
    "rack.boards.config.loader": ("load", "loads", "read_stored"),
    "rack.boards.config.resolved": ("Resolved", "resolve", "wire"),
    "rack.boards.config.schema": ("RackConfig",),
    "rack.boards.config.timing": ("budgets", "rack_timing"),
}

if not TYPE_CHECKING:  # a type checker would take every misspelt name for one of these
    __getattr__ = on_first_use(__name__, _PLACES)
