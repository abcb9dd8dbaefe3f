"""Messages between the Rack and its crate: requests, and the crate's answers.

This module imports nothing heavy: the first request is sent before the libraries that read a config
are loaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rack.boards.wiring import ClockWiring, HostWiring, TaskWiring
    from rack.levels.tables import RobotConfig, SceneConfig


@dataclass(frozen=True)
class CellConfig:
    """Inputs of the compiled cell."""

    robot: RobotConfig
    scene: SceneConfig
    clock_ns: int


@dataclass(frozen=True)
class Preload:
    """Import and preload these classes of levels, as "package.module:Class", with `path` as import
    path.

    With a cell, compile its cell, too. Boards forked later share all of it. What is loaded already
    costs nothing.
    """

    classes: tuple[str, ...]
    path: tuple[str, ...]
    cell: CellConfig | None = None


@dataclass(frozen=True)
class Open:
    """Attach to a rack's segment; take this SCHED_FIFO priority, if permitted.

    The crate must notice deaths without waiting for planners to finish; no board waits for the
    crate. With `before`, the rack goes on from the last snapshot at that tick or before.
    """

    rack: str
    priority: int
    before: int | None = None


@dataclass(frozen=True)
class HogWiring:
    """A hog: its entry in the fault table."""

    entry: int


@dataclass(frozen=True)
class PowerOn:
    """Fork one board: a task, the clock, a host board, or a hog, which occupies a board's core.

    In a rack that goes on from a snapshot, a board that is wired as it was then goes on.
    """

    name: str
    wiring: TaskWiring | ClockWiring | HostWiring | HogWiring


@dataclass(frozen=True)
class PowerOff:
    """Kill one board, or every board still running."""

    name: str | None = None


@dataclass(frozen=True)
class Leave:
    """End the boards of this rack, and wait for another one's requests."""


@dataclass(frozen=True)
class Left:
    """Answer to `Leave`: no board is left."""


@dataclass(frozen=True)
class Preloading:
    """The crate begins to preload a class."""

    kind: str


@dataclass(frozen=True)
class Compiling:
    """The crate begins to compile a function: its code is not kept from an earlier launch."""

    function: str


@dataclass(frozen=True)
class PreloadFailed:
    """A class raised an error while it was preloaded; no board can be forked."""

    kind: str
    error: str


@dataclass(frozen=True)
class Opened:
    """Answer to `Open`: the `tick` of the snapshot from which the rack goes on; -1: there is none,
    or none was wanted.
    """

    tick: int = -1


@dataclass(frozen=True)
class Show:
    """Show the attributes of the level of a task in the last snapshot at `tick` or before."""

    tick: int
    task: str


@dataclass(frozen=True)
class Shown:
    """Answer to `Show`: the tick of the snapshot, -1 without one, and the attributes as JSON."""

    tick: int
    attributes: str


@dataclass(frozen=True)
class Forked:
    """A board was forked."""

    name: str
    pid: int


@dataclass(frozen=True)
class Ended:
    """A board's process has ended; `status` is negative for a signal, as in subprocess.

    `seen_ns` (CLOCK_MONOTONIC) and `tick` are the time at which the crate noticed.
    """

    name: str
    pid: int
    status: int
    seen_ns: int
    tick: int


@dataclass(frozen=True)
class ForkFailed:
    """The system refused a process: a board has ended before it began."""

    end: Ended
    why: str
