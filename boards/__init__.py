"""The boards: one process a level, launched, watched and ended by the Rack.

    from rack.boards import Rack

    with Rack.from_file("nasrem") as rack:
        print(rack.run(seconds=10))

- `Rack` launches a config's boards, watches them, and ends them again; `Outcome` is how a run ended.
- `Event` is one thing that happened; `Rack(config, on_event=...)` hands each one to your program as it comes.
- `load` reads a config by name or path, with overrides; `RackConfig` is the result.
- `BoardError` is the root of all errors: `ConfigError` holds every `Mistake` of a config, `LaunchError` is a board that
  does not start.

Names are imported when they are first used: the crate and its boards import parts of this package and must stay small.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rack.boards.config import load
    from rack.boards.config.schema import RackConfig
    from rack.boards.crate.rack import Rack
    from rack.boards.errors import BoardError, ConfigError, LaunchError, Mistake
    from rack.boards.events import Cause, Event, EventKind, Outcome

__all__ = ["BoardError", "Cause", "ConfigError", "Event", "EventKind", "LaunchError", "Mistake", "Outcome", "Rack"]
__all__ += ["RackConfig", "load"]
_PLACES = {
    "rack.boards.config": ("load",),
    "rack.boards.config.schema": ("RackConfig",),
    "rack.boards.crate.rack": ("Rack",),
    "rack.boards.errors": ("BoardError", "ConfigError", "LaunchError", "Mistake"),
    "rack.boards.events": ("Cause", "Event", "EventKind", "Outcome"),
}


if not TYPE_CHECKING:  # a type checker would take every misspelt name for one of these

    def __getattr__(name: str) -> Any:
        for module, names in _PLACES.items():
            if name in names:
                return getattr(import_module(module), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
