"""The window of the viewer, a separate process that outlives the command that opened it.

The user may close it at any time.
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
PANIC_TEXT = "panicked at "


class ViewerWindow:
    """A viewer that shows the files of a recording, or the stream of a recorder.

    With a `port` it accepts commands on that port. Raises `Failure` if no viewer is installed, or
    if there is no screen and `headless` is False.
    """

    def __init__(self, *sources: str, headless: bool = False, port: int | None = None) -> None:
        if not (headless or has_screen()):
            raise Failure(
                "no screen: DISPLAY and WAYLAND_DISPLAY are not set; on a machine with a screen,"
                f" run: rerun {' '.join(sources)}"
            )
        # By default the viewer would listen on all network interfaces.
        command = [find_executable(), "--bind", HOST, *sources]
        if headless:
            command += ["--headless", "--hide-welcome-screen"]
        if port is not None:
            command += ["--port", str(port)]
        # Use a file, not a pipe, because nobody reads it while the viewer is open.
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

    def read_news(self) -> list[str]:
        """Return once how the window ended, and nothing while it is open."""
        if self._is_reported or self.is_open:
            return []
        self._is_reported = True
        return [self.wait_until_closed() or "the viewer was closed"]

    def wait_until_closed(self) -> str:
        """Wait until the window is closed. Returns the error, or "" if there was none."""
        if (status := self._process.wait()) == 0:
            return ""
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        # A panic prints its cause before the trace.
        panic = [line.partition(PANIC_TEXT)[2] for line in lines if PANIC_TEXT in line]
        return ": ".join([f"the viewer ended with status {status}", *(panic or lines[-1:])[:1]])

    def wait_for_end(self, bound_s: float) -> bool:
        """Wait at most `bound_s` for the window to end. Returns True if it has."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(bound_s)
        return not self.is_open

    @property
    def is_open(self) -> bool:
        """True while the viewer runs."""
        return self._process.poll() is None

    def close(self) -> None:
        """Close the window."""
        self._is_reported = True
        if self.is_open:
            # The command is a script that starts the viewer. Both are in its process group.
            os.killpg(self._process.pid, signal.SIGTERM)
            self._process.wait()
        self._said.close()


def has_screen() -> bool:
    """Return True if a window can be opened."""
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def find_executable() -> str:
    """Return the path of the installed viewer. Raises `Failure` if there is none."""
    beside_python = Path(sys.executable).with_name("rerun")
    path = str(beside_python) if beside_python.is_file() else shutil.which("rerun")
    if path is None:
        raise Failure("the viewer 'rerun' is not installed; 'make run' installs it")
    return path


def find_free_port() -> int:
    """Return a free port of this machine."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def format_url(port: int) -> str:
    """Return the address of the stream that a recorder serves on a port."""
    return f"rerun+http://{HOST}:{port}/proxy"
