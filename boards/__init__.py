"""The boards: one process per level, launched, supervised and ended by the Rack.

    from rack.boards import Rack

    with Rack.from_file("nasrem") as rack:
        print(rack.run(seconds=10))

- `Rack` launches the boards of a config, supervises them and ends them. `Outcome` describes how a
  run ended.
- `OneProcess` runs the levels of a config in one process, tick by tick, to test a level.
- `Event` is one occurrence in a run. `Rack(config, on_event=...)` passes each to your program as it
  happens.
- `load` reads a config by name or path, with overrides. `RackConfig` is the result.
- `BoardError` is the root of all errors: `ConfigError` contains every `Mistake` in a config, and
  `LaunchError` means that a rack with a correct config could not be launched.

Names are imported on first use, because the crate and its boards import parts of this package and
must stay small.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.exports import build_lazy_getattr

if TYPE_CHECKING:
    from rack.boards.config import load
    from rack.boards.config.schema import RackConfig
    from rack.boards.crate.one_process import OneProcess
    from rack.boards.crate.rack import Rack
    from rack.boards.errors import BoardError, ConfigError, LaunchError, Mistake
    from rack.boards.events import Cause, Event, EventKind, Outcome

__all__ = [
    "BoardError",
    "Cause",
    "ConfigError",
    "Event",
    "EventKind",
    "LaunchError",
    "Mistake",
    "OneProcess",
    "Outcome",
    "Rack",
    "RackConfig",
    "load",
]
_PLACES = {
    "rack.boards.config": ("load",),
    "rack.boards.config.schema": ("RackConfig",),
    "rack.boards.crate.rack": ("Rack",),
    "rack.boards.errors": ("BoardError", "ConfigError", "LaunchError", "Mistake"),
    "rack.boards.events": ("Cause", "Event", "EventKind", "Outcome"),
    "rack.boards.crate.one_process": ("OneProcess",),
}

if not TYPE_CHECKING:  # a type checker would take every misspelt name for one of these
    __getattr__ = build_lazy_getattr(__name__, _PLACES)
