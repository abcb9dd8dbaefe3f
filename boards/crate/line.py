"""The Rack's end of the line to its crate.

Creating a `CrateLine` starts the crate, which imports what boards need while its owner still reads
the config. This module therefore imports very little. The line is a `multiprocessing.connection` on
a socket pair between two processes of this program. Nothing else can reach the sockets, so pickles
are safe.
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

from rack.backplane.process import wait_readable
from rack.boards.crate.output import split_lines
from rack.boards.crate.requests import Leave, Show, Shown
from rack.boards.errors import LaunchError

LIBRARIES = {
    # The crate must have no threads when it forks, and a board has only one core.
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    # MuJoCo must not start a process that looks for OpenGL. Boards do not draw.
    "MUJOCO_GL": "disable",
}
"""Settings of libraries in the environment of a crate."""
TUNABLES = "GLIBC_TUNABLES"
SAME_LIBM = "glibc.cpu.hwcaps=-FMA,-FMA4"
"""Setting that makes the mathematical functions of the C library independent of the processor.

The library has versions of `sin`, `exp` and others with and without fused multiply-add. It selects
one by processor, and they differ in the last bit. MuJoCo, OMPL, ruckig and Python's `math` call
them. Boards use the version without fused multiply-add, which runs on every processor. The library
selects at the start of a process, so the setting must be in the environment.
"""
END_S = 1.0
"""Time that a crate has to end its snapshots and itself before it is killed."""
LEAVE_S = 10.0
"""Longest wait until a crate has left a rack. The crate may still be importing modules."""


class CrateLine:
    """A running crate: connection, notifications and output of its boards.

    A `Rack` closes the line that it is given. Use the line as a context manager if there may be no
    Rack to close it.

    Attributes:
        line: Connection to the crate.
        attention: Descriptor of the eventfd to which boards write.
    """

    def __init__(self) -> None:
        self.line, crate_end = Pipe()
        self.attention = os.eventfd(0, os.EFD_NONBLOCK)
        # Boards print into a file in memory, so that they never wait for a reader.
        self._printed = os.memfd_create("boards")
        self._read_to = 0
        self._process = subprocess.Popen(
            # Output must not be buffered, because boards end by `os._exit`, which flushes nothing.
            [
                sys.executable,
                "-u",
                "-P",
                "-m",
                "rack.boards.crate",
                str(crate_end.fileno()),
                str(self.attention),
            ],
            pass_fds=(crate_end.fileno(), self.attention),
            stdin=subprocess.DEVNULL,
            stdout=self._printed,
            stderr=self._printed,
            env=build_environment(),
        )
        crate_end.close()
        self.is_over = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close(0)

    @property
    def pid(self) -> int:
        """Process id of the crate."""
        return self._process.pid

    def read_output(self) -> list[str]:
        """Return the lines that boards have printed since the last call.

        Returns:
            The lines. Empty once the crate has been ended.
        """
        if self.is_over:
            return []
        data = os.pread(self._printed, 1 << 20, self._read_to)
        lines = split_lines(data)
        self._read_to += sum(map(len, lines))
        return [text for line in lines for text in line.decode(errors="replace").splitlines()]

    def build_error(self, otherwise: str) -> LaunchError:
        """Build an error with the last output of the boards, or `otherwise` if there is none."""
        return LaunchError("\n".join(self.read_output()) or otherwise)

    def send_request(self, request: object) -> None:
        """Send a request. If the crate has ended, raise `LaunchError` with its last output."""
        try:
            self.line.send(request)
        except OSError:
            raise self.build_error("the crate has ended") from None

    def try_request(self, request: object) -> None:
        """Send a request to the crate. Do nothing if the crate has ended.

        The caller learns of the end from `receive_message`, which then returns None.
        """
        with suppress(LaunchError):
            self.send_request(request)

    def receive_message(self) -> object:
        """Wait for the crate's next message and return it. None if the crate has ended."""
        return receive_or_none(self.line)

    def close(self, timeout_s: float) -> None:
        """Close the line, so that the crate ends its boards and itself.

        Args:
            timeout_s: Time in s after which the crate is killed.
        """
        if self.is_over:
            return
        self.is_over = True
        self.line.close()
        # `Popen.wait` with a time-out sleeps in steps of up to 50 ms, which delays every end.
        ended = os.pidfd_open(self._process.pid)
        if not wait_readable(ended, timeout_s):
            self._process.kill()
        self._process.wait()
        os.close(ended)
        os.close(self.attention)
        os.close(self._printed)


class WarmCrate(CrateLine):
    """Crate for several racks in succession, which keeps imported and compiled code.

    When a Rack closes the crate, the crate only leaves that rack. Its owner must call `end_crate`
    or use it as a context manager.

    Attributes:
        is_last: Whether the crate ends when its present rack is closed.
    """

    is_last = False

    def __exit__(self, *error: object) -> None:
        self.end_crate()

    def close(self, timeout_s: float) -> None:
        """Make the crate end the boards of its rack, and wait until they have ended.

        If `is_last` is set, or if this takes longer than `LEAVE_S`, end the crate itself as well.

        Args:
            timeout_s: Time in s after which the crate is killed if it does not end. Used only if
                `is_last` is set.
        """
        if self.is_over:
            return
        if self.is_last:
            super().close(timeout_s)
            return
        self.try_request(Leave())
        deadline = time.monotonic() + LEAVE_S
        answer: object = self
        while answer is not None and self.line.poll(max(0.0, deadline - time.monotonic())):
            answer = self.receive_message()
            if isinstance(answer, Leave):
                self.read_output()
                with suppress(BlockingIOError):
                    os.eventfd_read(self.attention)
                return
        self.end_crate()

    def read_attributes(self, tick: int, task: str) -> Shown:
        """Read the attributes of a level from a snapshot.

        Args:
            tick: The last snapshot at or before this tick is read.
            task: Task of the level. Empty to get only the tick of the snapshot.

        Returns:
            The tick of the snapshot and the attributes as JSON. The tick is -1 if there is no such
            snapshot.
        """
        self.try_request(Show(tick, task))
        while not isinstance(answer := self.receive_message(), Shown | None):
            continue
        return answer or Shown(-1, "")

    def end_crate(self) -> None:
        """End the crate, which drops its snapshots."""
        super().close(END_S)


def build_environment() -> dict[str, str]:
    """Return the environment of the crate.

    It is the environment of this process, with settings that make runs repeat exactly.
    """
    return {
        **os.environ,
        **LIBRARIES,
        TUNABLES: ":".join(filter(None, (os.environ.get(TUNABLES), SAME_LIBM))),
        "PYTHONPATH": os.pathsep.join(sys.path),
    }


def receive_or_none(line: Connection) -> object:
    """Wait for the next message on a line and return it. None if the other end is gone."""
    try:
        return line.recv()
    except (EOFError, OSError):
        return None
