"""Configs of racks: reading, checking and wiring.

- `load(name, overrides, faults)` and `load_text(text)` read and validate the tables and return a
  `RackConfig`. Its levels can be imported afterwards.
- `read_stored(text)` reads the config of a rack or a run and imports nothing.
- `resolve(config)` checks and wires everything and returns `Resolved`: config, layout, wiring,
  faults and commands.
- `resolve_layout(config)` returns the layout alone.
- `list_replaced_cores(config)` returns a line for every requested core that does not exist.
- `list_names()`, `CONFIGS` and `FAULTS` are the bundled configs and fault scripts.
- `read_budgets(config)` and `build_rack_timing(config, layout)` describe the config in the terms of
  the timing model.

A config with mistakes raises a `ConfigError`, which reports all of them at once.
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

# Hidden from type checkers, which would otherwise accept every misspelt name.
if not TYPE_CHECKING:
    __getattr__ = on_first_use(__name__, _PLACES)
