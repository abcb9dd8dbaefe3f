"""The launcher's side of a bridge process: start, messages for the user, end."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial

from rack.backplane.process import describe_end, die_with_parent, wait_readable

ATTACH_S = 20.0
"""Longest time for which a launch waits until a bridge is connected."""
END_S = 1.0
"""Longest time for which the end of a run waits for the end of a bridge."""


class BridgeProcess:
    """Starts a bridge beside a rack that is about to run. The rack never depends on it.

    The process starts at once, and imports its libraries while the rack is being launched.

    Args:
        name: Name of the bridge.
        stack: Context at whose end the process ends.
    """

    def __init__(self, name: str, stack: ExitStack) -> None:
        self._name = name
        self._rack = ""
        self._unread = b""
        self._has_ended = False
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "rack.tools.bridges", name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            process_group=0,
            preexec_fn=partial(die_with_parent, os.getpid()),
        )
        assert self._process.stdin is not None, "it is a pipe"
        assert self._process.stdout is not None, "it is a pipe"
        self._input, self._output = self._process.stdin, self._process.stdout
        stack.callback(self._close)

    def attach(self, rack: str) -> Callable[[], list[str]]:
        """Connect the bridge to a rack, and wait until it reports its first line or ends.

        Returns:
            A function that returns new messages for the user.
        """
        self._rack = rack
        with suppress(OSError):
            self._input.write(f"{rack}\n".encode())
            self._input.close()
        wait_readable(self._output.fileno(), ATTACH_S)
        return self._read_notices

    def _read_notices(self) -> list[str]:
        """Return new messages for the user. The last one reports an end before that of the run."""
        while not self._has_ended and wait_readable(self._output.fileno(), 0.0):
            self._unread += os.read(self._output.fileno(), 1 << 16) or self._describe_end()
        *lines, self._unread = self._unread.split(b"\n")
        return [f"{self._name}: {line.decode(errors='replace')}" for line in lines]

    def _describe_end(self) -> bytes:
        """Return a line about the end of the process. Empty if it has done its work."""
        self._has_ended = True
        if not (status := self._process.wait()):
            return b""
        again = f"rack bridge {self._rack} {self._name}"
        return f"ended ({describe_end(status)}); the rack goes on; again: {again}\n".encode()

    def _close(self) -> None:
        """Wait for the end of the process, which the end of the run causes, or kill it."""
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._output.close()
