"""What the Rack and its crate say to each other."""

from __future__ import annotations

from dataclasses import dataclass

from boards.clock_board import ClockWiring
from boards.wiring import TaskWiring


@dataclass(frozen=True)
class Preload:
    """Import these modules, found on `path`; boards forked later share them."""

    modules: tuple[str, ...]
    path: tuple[str, ...]


@dataclass(frozen=True)
class Open:
    """Attach to a rack's segment and open its semaphores."""

    rack: str


@dataclass(frozen=True)
class PowerOn:
    """Fork one board: a task, or the clock."""

    name: str
    wiring: TaskWiring | ClockWiring


@dataclass(frozen=True)
class PowerOff:
    """Kill every board that still runs."""


@dataclass(frozen=True)
class Opened:
    """Answer to `Open`."""


@dataclass(frozen=True)
class Forked:
    """A board runs."""

    name: str
    pid: int


@dataclass(frozen=True)
class Ended:
    """A board's process has ended; `status` is negative for a signal, as in subprocess."""

    name: str
    pid: int
    status: int
