"""Requests of the Rack to its crate, and the crate's answers.

This module imports very little, because the first request is sent before the libraries that read a
config are loaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rack.boards.wiring import ClockWiring, HostWiring, TaskWiring
    from rack.levels.tables import RobotConfig, SceneConfig


@dataclass(frozen=True)
class CellConfig:
    """Tables of a config from which the cell is compiled."""

    robot: RobotConfig
    scene: SceneConfig
    clock_ns: int


@dataclass(frozen=True)
class Preload:
    """Request to import and preload levels, which the boards forked later then share.

    Attributes:
        classes: Classes of levels, as "package.module:Class". Loaded classes are skipped.
        path: The import path.
        cell: Cell that is compiled as well. None for a rack without an arm.
    """

    classes: tuple[str, ...]
    path: tuple[str, ...]
    cell: CellConfig | None = None


@dataclass(frozen=True)
class Open:
    """Request to attach to the segment of a rack.

    Attributes:
        rack: Name of the rack.
        priority: SCHED_FIFO priority of the crate, if the system permits it. The crate must notice
            the end of a board even while planners compute, but no board waits for the crate.
        before: Continue from the last snapshot at or before this tick. None for a new run.
    """

    rack: str
    priority: int
    before: int | None = None


@dataclass(frozen=True)
class PowerOn:
    """Request to fork one process: a task, the clock, a host board or a hog.

    The wiring of a hog, which occupies a core, is the index of its fault in the fault table.

    If the rack continues from a snapshot and the wiring is unchanged, the board's copy continues
    instead.
    """

    name: str
    wiring: TaskWiring | ClockWiring | HostWiring | int


@dataclass(frozen=True)
class PowerOff:
    """Request to kill one board. Without a name, every board that is still running is killed."""

    name: str | None = None


@dataclass(frozen=True)
class Leave:
    """Request to end the boards of this rack and wait for requests of another rack."""


@dataclass(frozen=True)
class Left:
    """Answer to `Leave`: all boards of the rack have ended."""


@dataclass(frozen=True)
class Preloading:
    """Report that the crate begins to preload a class."""

    kind: str


@dataclass(frozen=True)
class Compiling:
    """Report that the crate begins to compile a function that no earlier launch has compiled."""

    function: str


@dataclass(frozen=True)
class PreloadFailed:
    """Report that preloading a class failed, so that no board can be forked."""

    kind: str
    error: str


@dataclass(frozen=True)
class Opened:
    """Answer to `Open`.

    Attributes:
        tick: Tick of the snapshot from which the rack continues. -1 without one.
    """

    tick: int = -1


@dataclass(frozen=True)
class Show:
    """Request for the attributes of a task's level in the last snapshot at or before a tick."""

    tick: int
    task: str


@dataclass(frozen=True)
class Shown:
    """Answer to `Show`.

    Attributes:
        tick: Tick of the snapshot. -1 without one.
        attributes: Attributes of the level, as JSON.
    """

    tick: int
    attributes: str


@dataclass(frozen=True)
class Forked:
    """Report that a board was forked."""

    name: str
    pid: int


@dataclass(frozen=True)
class Ended:
    """Report that the process of a board has ended.

    Attributes:
        name: Name of the board.
        status: Exit status. Negative for a signal, as in `subprocess`.
        seen_ns: CLOCK_MONOTONIC time in ns at which the crate noticed the end.
        tick: Tick at which the board was lost.
    """

    name: str
    status: int
    seen_ns: int
    tick: int


@dataclass(frozen=True)
class ForkFailed:
    """Report that a board could not be forked: a record of its end, and the reason."""

    end: Ended
    why: str
