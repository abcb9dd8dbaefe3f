"""Requests of the Rack to its crate, and the crate's answers.

This module imports very little, because the first request is sent before the libraries that read a
config are loaded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from rack.boards.wiring import ClockWiring, HostWiring, TaskWiring
    from rack.levels.tables import RobotConfig, SceneConfig


class CellConfig(NamedTuple):
    """Tables of a config from which the cell is compiled."""

    robot: RobotConfig
    scene: SceneConfig
    clock_ns: int


class Preload(NamedTuple):
    """Request to import and preload levels, which the boards forked later then share.

    Attributes:
        classes: Classes of levels, as "package.module:Class". Loaded classes are skipped.
        path: The import path.
        cell: Cell that is compiled as well. None for a rack without an arm.
    """

    classes: tuple[str, ...]
    path: tuple[str, ...]
    cell: CellConfig | None = None


class Open(NamedTuple):
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


class PowerOn(NamedTuple):
    """Request to fork one process: a task, the clock, a host board or a hog.

    The wiring of a hog, which occupies a core, is the index of its fault in the fault table.

    If the rack continues from a snapshot and the wiring is unchanged, the board's copy continues
    instead.
    """

    name: str
    wiring: TaskWiring | ClockWiring | HostWiring | int


class PowerOff(NamedTuple):
    """Request to kill one board. Without a name, every board that is still running is killed."""

    name: str | None = None


class Leave(NamedTuple):
    """Request to end the boards of this rack and wait for requests of another rack.

    The crate sends it back when all boards have ended.
    """


class Preloading(NamedTuple):
    """Report that the crate begins to preload a class."""

    kind: str


class Compiling(NamedTuple):
    """Report that the crate begins to compile a function that no earlier launch has compiled."""

    function: str


class PreloadFailed(NamedTuple):
    """Report that preloading a class failed, so that no board can be forked."""

    kind: str
    error: str


class Opened(NamedTuple):
    """Answer to `Open`.

    Attributes:
        tick: Tick of the snapshot from which the rack continues. -1 without one.
    """

    tick: int


class Show(NamedTuple):
    """Request for the attributes of a task's level in the last snapshot at or before a tick."""

    tick: int
    task: str


class Shown(NamedTuple):
    """Answer to `Show`.

    Attributes:
        tick: Tick of the snapshot. -1 without one.
        attributes: Attributes of the level, as JSON.
    """

    tick: int
    attributes: str


class Forked(NamedTuple):
    """Report that a board was forked."""

    name: str
    pid: int


class Ended(NamedTuple):
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


class ForkFailed(NamedTuple):
    """Report that a board could not be forked: a record of its end, and the reason."""

    end: Ended
    why: str
