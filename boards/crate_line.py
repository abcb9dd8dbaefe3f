"""The Rack's end of the crate: starts it, and hears from it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from contextlib import suppress

from rack.boards.channel import Channel
from rack.boards.errors import LaunchError

SINGLE_THREADED = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""The crate must not have threads when it forks, and a board's mathematics belong on its own core."""
TUNABLES = "GLIBC_TUNABLES"
SAME_LIBM = "glibc.cpu.hwcaps=-FMA,-FMA4"
"""The C library has `sin`, `exp` and the like twice, with fused multiply-add and without, takes what the processor has,
and the two differ in the last bit. MuJoCo, OMPL, ruckig and Python's `math` call them: boards take those without, which
every processor has. (It is read when a process starts, so the Rack's environment is the only place for it.)"""


class CrateLine:
    """A running crate: its line, the eventfd on which its boards ring, and what they print."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        self.attention = os.eventfd(0, os.EFD_NONBLOCK)
        # A file in memory: a board that prints never waits for a reader.
        self._printed = os.memfd_create("boards")
        self._read_to = 0
        self._process = subprocess.Popen(
            # Unbuffered: a board leaves by no way that would write out what it has printed.
            [sys.executable, "-u", "-m", "rack.boards.crate", str(theirs.fileno()), str(self.attention)],
            pass_fds=(theirs.fileno(), self.attention),
            stdin=subprocess.DEVNULL,
            stdout=self._printed,
            stderr=self._printed,
            env=environment(),
        )
        theirs.close()
        self.line = Channel(ours)

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
        """Hand a request to the crate. Raises `LaunchError`, with what it has printed, when it is gone."""
        try:
            self.line.send(request)
        except OSError:
            raise LaunchError("\n".join(self.printed()) or "the crate has ended") from None

    def ask(self, request: object) -> None:
        """Hand a request to the crate; when it is gone, whoever hears the line learns that."""
        with suppress(LaunchError):
            self.send(request)

    def close(self, timeout_s: float) -> None:
        """Close the line, whereupon the crate ends its boards and itself; kill it should it not."""
        self.line.socket.close()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self.attention)
        os.close(self._printed)


def environment() -> dict[str, str]:
    """Return the environment of the crate and its boards: the Rack's own, and what keeps a run repeatable."""
    tunables = ":".join(filter(None, (os.environ.get(TUNABLES), SAME_LIBM)))
    return {**os.environ, **SINGLE_THREADED, TUNABLES: tunables, "PYTHONPATH": os.pathsep.join(sys.path)}
