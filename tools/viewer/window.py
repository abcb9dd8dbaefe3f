"""The viewer's window: a separate process, which may be closed at any time and outlives the command
that opened it.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

from rack.tools.console.answer import Failure

HOST = "127.0.0.1"
PANIC = "panicked at "


class ViewerWindow:
    """A viewer that shows a recording's files or a recorder's stream; with a `port` it accepts
    commands there.

    Raises `Failure` when none is installed, or there is no screen and it is not `headless`.
    """

    def __init__(self, *sources: str, headless: bool = False, port: int | None = None) -> None:
        if not (headless or has_screen()):
            raise Failure(
                "no screen: DISPLAY and WAYLAND_DISPLAY are not set; on a machine with one: rerun"
                f" {' '.join(sources)}"
            )
        # By default the viewer would listen on every network.
        command = [executable(), "--bind", HOST, *sources]
        if headless:
            command += ["--headless", "--hide-welcome-screen"]
        if port is not None:
            command += ["--port", str(port)]
        # A file, not a pipe: nobody reads it while the viewer is open.
        self._said = tempfile.TemporaryFile()  # noqa: SIM115  open as long as the window
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._said,
            # Ctrl-C in the terminal ends the run, not the viewer.
            start_new_session=True,
        )
        self._is_reported = False

    def news(self) -> list[str]:
        """Return how the window ended, once; nothing while it is open."""
        if self._is_reported or self.is_open:
            return []
        self._is_reported = True
        return [self.wait() or "the viewer was closed"]

    def wait(self) -> str:
        """Wait until the window is closed; return what went wrong, or an empty text."""
        if (status := self._process.wait()) == 0:
            return ""
        self._said.seek(0)
        said = self._said.read().decode(errors="replace").strip().splitlines()
        # A panic prints its cause first, then a trace.
        panic = [line.partition(PANIC)[2] for line in said if PANIC in line]
        return ": ".join([f"the viewer ended with status {status}", *(panic or said[-1:])[:1]])

    def ends_within(self, bound_s: float) -> bool:
        """Wait for its end, at most so long; return whether it came."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(bound_s)
        return not self.is_open

    @property
    def is_open(self) -> bool:
        """Whether the viewer runs."""
        return self._process.poll() is None

    def close(self) -> None:
        """Close it."""
        self._is_reported = True
        if self.is_open:
            # The command is a script that starts the viewer: both are in its process group.
            os.killpg(self._process.pid, signal.SIGTERM)
            self._process.wait()
        self._said.close()


def has_screen() -> bool:
    """Return whether a window can be opened."""
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def executable() -> str:
    """Return the viewer that came with the installed package. Raises `Failure`."""
    own = Path(sys.executable).with_name("rerun")
    found = str(own) if own.is_file() else shutil.which("rerun")
    if found is None:
        raise Failure("the viewer 'rerun' is not installed; 'make run' installs it")
    return found


def free_port() -> int:
    """Return a free port of this machine."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def url(port: int) -> str:
    """Return the address at which a recorder serves its stream."""
    return f"rerun+http://{HOST}:{port}/proxy"
