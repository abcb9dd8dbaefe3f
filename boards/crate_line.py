"""The Rack's end of the crate: starts it, and hears from it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from boards.channel import Channel
from boards.errors import LaunchError

PROJECT = Path(__file__).resolve().parent.parent
SINGLE_THREADED = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""The crate must not have threads when it forks, and a board's mathematics belong on its own core."""


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
            [sys.executable, "-u", "-m", "boards.crate", str(theirs.fileno()), str(self.attention)],
            pass_fds=(theirs.fileno(), self.attention),
            stdin=subprocess.DEVNULL,
            stdout=self._printed,
            stderr=self._printed,
            env={**os.environ, **SINGLE_THREADED, "PYTHONPATH": os.pathsep.join([str(PROJECT), *sys.path])},
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
