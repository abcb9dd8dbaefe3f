"""The line between the Rack and its crate: the Rack's end.

The crate starts with this object and imports what boards need while its owner still reads the
config, so this module imports next to nothing. The line is a `multiprocessing.connection` on a
socket pair. Both ends are processes of this program, one started by the other. Nothing else can
reach the sockets, so pickles are safe.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Self

from rack.boards.crate.output import lines_of
from rack.boards.crate.requests import Leave, Left, Show, Shown
from rack.boards.errors import LaunchError

SINGLE_THREADED = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""No threads in numerical libraries: the crate must have none when it forks, and a board has only
its own core."""
TUNABLES = "GLIBC_TUNABLES"
SAME_LIBM = "glibc.cpu.hwcaps=-FMA,-FMA4"
"""The C library has two versions of `sin`, `exp` and others, with and without fused multiply-add.
It selects one by processor, and they differ in the last bit. MuJoCo, OMPL, ruckig and Python's
`math` call them. Boards use the version without, which runs on every processor. The choice is made
at process start, so it must be in the environment."""
END_S = 1.0
"""Time for a crate to end its snapshots and itself, before it is killed."""
LEAVE_S = 10.0
"""Longest time that a crate takes to leave a rack: it may still be importing."""
NO_WINDOWS = {"MUJOCO_GL": "disable"}
"""Neither boards nor Rack draw: without this, importing MuJoCo also starts a process that looks for
OpenGL."""


class CrateLine:
    """A running crate: the line to it, the eventfd `attention` to which its boards write, and their
    output.

    A `Rack` closes the line that it is given. As a context it is closed, too, if no Rack came to
    that.
    """

    def __init__(self) -> None:
        self.line, theirs = Pipe()
        self.attention = os.eventfd(0, os.EFD_NONBLOCK)
        # A file in memory, so that printing boards never wait for a reader.
        self._printed = os.memfd_create("boards")
        self._read_to = 0
        self._process = subprocess.Popen(
            # Unbuffered: a board ends by `os._exit`, which flushes no buffer.
            [
                sys.executable,
                "-u",
                "-P",
                "-m",
                "rack.boards.crate",
                str(theirs.fileno()),
                str(self.attention),
            ],
            pass_fds=(theirs.fileno(), self.attention),
            stdin=subprocess.DEVNULL,
            stdout=self._printed,
            stderr=self._printed,
            env=environment(),
        )
        theirs.close()
        self._is_closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close(0)

    @property
    def pid(self) -> int:
        """Process id of the crate."""
        return self._process.pid

    def printed(self) -> list[str]:
        """Return the lines printed by boards since the last call."""
        data = os.pread(self._printed, 1 << 20, self._read_to)
        whole = lines_of(data)
        self._read_to += sum(map(len, whole))
        return [line for part in whole for line in part.decode(errors="replace").splitlines()]

    def send(self, request: object) -> None:
        """Send a request to the crate. Raises `LaunchError`, with its output, if it is gone."""
        try:
            self.line.send(request)
        except OSError:
            raise LaunchError("\n".join(self.printed()) or "the crate has ended") from None

    def ask(self, request: object) -> None:
        """Send a request to the crate; if it is gone, `receive` will notice."""
        with suppress(LaunchError):
            self.send(request)

    def receive(self) -> object:
        """Return the crate's next message; None if the crate is gone."""
        return received(self.line)

    def close(self, timeout_s: float) -> None:
        """Close the line, which makes the crate end its boards and itself; kill it after the
        timeout.
        """
        if self._is_closed:
            return
        self._is_closed = True
        self.line.close()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self.attention)
        os.close(self._printed)


class WarmCrate(CrateLine):
    """A crate for several racks, one after the other: what it has imported and compiled stays.

    A Rack that closes it makes it leave the rack. Its owner ends it, or the context does.
    `is_over`: it was ended, or did not leave a rack in time, and serves no more. It ends with its
    present rack if that `is_last`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.is_last = False

    def __exit__(self, *error: object) -> None:
        self.end()

    @property
    def is_over(self) -> bool:
        """Whether it serves no more racks."""
        return self._is_closed

    def close(self, timeout_s: float) -> None:
        """Have it end the boards of the rack, and wait until none is left."""
        if self._is_closed:
            return
        if self.is_last:
            super().close(timeout_s)
            return
        self.ask(Leave())
        deadline = time.monotonic() + LEAVE_S
        answer: object = self
        while answer is not None and self.line.poll(max(0.0, deadline - time.monotonic())):
            answer = self.receive()
            if isinstance(answer, Left):
                self.printed()
                with suppress(BlockingIOError):
                    os.eventfd_read(self.attention)
                return
        self.end()

    def show(self, tick: int, task: str) -> Shown:
        """Return the tick of the last snapshot at `tick` or before, -1 without one, and the
        attributes of the level of a task there; none without a task.
        """
        self.ask(Show(tick, task))
        answer: object = self
        while answer is not None and not isinstance(answer, Shown):
            answer = self.receive()
        return answer or Shown(-1, "")

    def end(self) -> None:
        """End the crate, and its snapshots."""
        super().close(END_S)


def environment() -> dict[str, str]:
    """Return the environment of the crate and its boards: the Rack's own, with settings that make
    runs repeatable.
    """
    tunables = ":".join(filter(None, (os.environ.get(TUNABLES), SAME_LIBM)))
    return {
        **os.environ,
        **SINGLE_THREADED,
        **NO_WINDOWS,
        TUNABLES: tunables,
        "PYTHONPATH": os.pathsep.join(sys.path),
    }


def received(line: Connection) -> object:
    """Return the next message on a line; None if the other end is gone."""
    try:
        return line.recv()
    except (EOFError, OSError):
        return None
