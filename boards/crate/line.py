"""The line between the Rack and its crate: the messages, and the Rack's end.

The line is a `multiprocessing.connection` on a pair of connected sockets. Both ends are this program's own processes,
one started by the other; nothing else can reach the sockets, so pickles are safe.
"""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection

from rack.boards.errors import LaunchError
from rack.boards.wiring import ClockWiring, TaskWiring

SINGLE_THREADED = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""No threads in mathematics: the crate must have none when it forks, and a board computes on its own core."""
TUNABLES = "GLIBC_TUNABLES"
SAME_LIBM = "glibc.cpu.hwcaps=-FMA,-FMA4"
"""The C library has two versions of `sin`, `exp` and others, with and without fused multiply-add. It takes the one that
suits the processor, and the two differ in the last bit. MuJoCo, OMPL, ruckig and Python's `math` call them. Boards use
the one without, which runs on every processor. It is set when a process starts, so it must be in the environment."""


@dataclass(frozen=True)
class Preload:
    """Import these modules, with `path` as module path; boards forked later share them."""

    modules: tuple[str, ...]
    path: tuple[str, ...]


@dataclass(frozen=True)
class Open:
    """Attach to a rack's segment and open its semaphores; take this SCHED_FIFO priority, if allowed.

    The crate sees deaths, for which it must not wait until planners are done; no board waits for the crate.
    """

    rack: str
    priority: int


@dataclass(frozen=True)
class HogWiring:
    """A hog, and its entry in the fault table."""

    entry: int


@dataclass(frozen=True)
class PowerOn:
    """Fork one board: a task, the clock, or a hog: a process that takes a board's core away."""

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
    """A board was forked."""

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


class CrateLine:
    """A running crate: the line to it, the eventfd `attention` that its boards write to, and their output."""

    def __init__(self) -> None:
        self.line, theirs = Pipe()
        self.attention = os.eventfd(0, os.EFD_NONBLOCK)
        # A file in memory, so that a board that prints never waits for a reader.
        self._printed = os.memfd_create("boards")
        self._read_to = 0
        self._process = subprocess.Popen(
            # Unbuffered: a board leaves by `os._exit`, which writes no buffer out.
            [sys.executable, "-u", "-m", "rack.boards.crate.crate", str(theirs.fileno()), str(self.attention)],
            pass_fds=(theirs.fileno(), self.attention),
            stdin=subprocess.DEVNULL,
            stdout=self._printed,
            stderr=self._printed,
            env=environment(),
        )
        theirs.close()

    @property
    def pid(self) -> int:
        """Process id of the crate."""
        return self._process.pid

    def printed(self) -> list[str]:
        """Return the lines that boards have printed since the last call."""
        data = os.pread(self._printed, 1 << 20, self._read_to)
        whole = data[: data.rfind(b"\n") + 1]
        self._read_to += len(whole)
        return whole.decode(errors="replace").splitlines()

    def send(self, request: object) -> None:
        """Send a request to the crate. Raises `LaunchError`, with its output, when it is gone."""
        try:
            self.line.send(request)
        except OSError:
            raise LaunchError("\n".join(self.printed()) or "the crate has ended") from None

    def ask(self, request: object) -> None:
        """Send a request to the crate; if it is gone, `receive` finds out."""
        with suppress(LaunchError):
            self.send(request)

    def receive(self) -> object:
        """Return the crate's next message; None when the crate is gone."""
        return received(self.line)

    def close(self, timeout_s: float) -> None:
        """Close the line: the crate then ends its boards and itself. Kill it if it does not in time."""
        self.line.close()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self.attention)
        os.close(self._printed)


def environment() -> dict[str, str]:
    """Return the environment of the crate and its boards: the Rack's own, with settings that keep runs repeatable."""
    tunables = ":".join(filter(None, (os.environ.get(TUNABLES), SAME_LIBM)))
    return {**os.environ, **SINGLE_THREADED, TUNABLES: tunables, "PYTHONPATH": os.pathsep.join(sys.path)}


def received(line: Connection) -> object:
    """Return the next message on a line; None when the other end is gone."""
    try:
        return line.recv()
    except (EOFError, OSError):
        return None
