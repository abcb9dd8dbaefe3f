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

from rack.backplane.exports import build_lazy_getattr

if TYPE_CHECKING:
    from rack.boards.config.files import CONFIGS, FAULTS, list_names
    from rack.boards.config.layout import list_replaced_cores
    from rack.boards.config.loader import load, load_text, read_stored
    from rack.boards.config.resolved import Resolved, resolve, resolve_layout
    from rack.boards.config.schema import RackConfig
    from rack.boards.config.timing import build_rack_timing, read_budgets

__all__ = [
    "CONFIGS",
    "FAULTS",
    "RackConfig",
    "Resolved",
    "build_rack_timing",
    "list_names",
    "list_replaced_cores",
    "load",
    "load_text",
    "read_budgets",
    "read_stored",
    "resolve",
    "resolve_layout",
]
_PLACES = {
    "rack.boards.config.files": ("CONFIGS", "FAULTS", "list_names"),
    "rack.boards.config.layout": ("list_replaced_cores",),
    "rack.boards.config.loader": ("load", "load_text", "read_stored"),
    "rack.boards.config.resolved": ("Resolved", "resolve", "resolve_layout"),
    "rack.boards.config.schema": ("RackConfig",),
    "rack.boards.config.timing": ("read_budgets", "build_rack_timing"),
}

# Hidden from type checkers, which would otherwise accept every misspelt name.
if not TYPE_CHECKING:
    __getattr__ = build_lazy_getattr(__name__, _PLACES)
