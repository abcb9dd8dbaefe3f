"""The viewer's window: a process of its own, which may close at any time."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
from pathlib import Path

from tools.answer import Failure

HOST = "127.0.0.1"


class Window:
    """A viewer that shows a recording's file, or what a recorder serves.

    Raises `Failure` when none is installed.
    """

    def __init__(self, source: str) -> None:
        self._process = subprocess.Popen(
            [executable(), source], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )

        self._is_told = False

    def told(self) -> list[str]:
        """Return how the window ended, in words, once; nothing while it is open."""
        if self._is_told or self._process.poll() is None:
            return []
        self._is_told = True
        return [self.wait() or "the viewer was closed"]

    def wait(self) -> str:
        """Wait until the window is closed; return what went wrong, if anything did."""
        said = self._process.communicate()[1].decode(errors="replace").strip().splitlines()
        status = self._process.returncode
        return ": ".join([f"the viewer ended with status {status}", *said[-1:]]) if status else ""


def executable() -> str:
    """Return the viewer that came with the installed package. Raises `Failure`."""
    own = Path(sys.executable).with_name("rerun")
    found = str(own) if own.is_file() else shutil.which("rerun")
    if found is None:
        raise Failure("the viewer 'rerun' is not installed; 'make run' installs it", 1)
    return found


def free_port() -> int:
    """Return a port of this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def url(port: int) -> str:
    """Return where a recorder serves its stream."""
    return f"rerun+http://{HOST}:{port}/proxy"
