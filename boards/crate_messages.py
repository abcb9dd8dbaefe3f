"""What the Rack and its crate say to each other."""

from __future__ import annotations

from dataclasses import dataclass

from rack.boards.wiring import ClockWiring, TaskWiring


@dataclass(frozen=True)
class Preload:
    """Import these modules, found on `path`; boards forked later share them."""

    modules: tuple[str, ...]
    path: tuple[str, ...]


@dataclass(frozen=True)
class Open:
    """Attach to a rack's segment and open its semaphores; take this SCHED_FIFO priority, if allowed.

    The crate sees deaths, and must not wait for planners to do so; no board waits for it.
    """

    rack: str
    priority: int


@dataclass(frozen=True)
class HogWiring:
    """A hog, and the entry of the fault table that it does."""

    entry: int


@dataclass(frozen=True)
class PowerOn:
    """Fork one board: a task, the clock, or a hog, which is no board and takes one's core away."""

    name: str
    wiring: TaskWiring | ClockWiring | HogWiring


@dataclass(frozen=True)
class PowerOff:
    """Kill one board, or every board that still runs."""

    name: str | None = None


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
    """A board's process has ended; `status` is negative for a signal, as in subprocess.

    `seen_ns` is when the crate saw it, CLOCK_MONOTONIC, and `tick` the system clock's then.
    """

    name: str
    pid: int
    status: int
    seen_ns: int
    tick: int
