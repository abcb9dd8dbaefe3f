"""The window of the viewer, a separate process.

The user may close the window at any time. It stays open when the command that opened it ends.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from rack.tools.console.answer import Failure

HOST = "127.0.0.1"
PANIC_TEXT = "panicked at "
ENDING_S = 1.0
"""Time that a viewer has to end when it is closed. Then it is killed."""


class ViewerWindow:
    """A viewer process that shows files of a recording, or the stream that a recorder serves.

    With a `port`, the viewer accepts commands on that port. A `headless` viewer opens no window.
    Raises `Failure` if the viewer is not installed, or if the machine has no screen and `headless`
    is False.
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
            # Ctrl-C in the terminal ends the run, not the viewer. A headless viewer ends with its
            # command, which kills the processes of its session.
            start_new_session=not headless,
            process_group=0 if headless else None,
        )
        self._is_reported = False

    def read_notices(self) -> list[str]:
        """Return a message about the end of the viewer, once it has ended.

        Returns:
            A list with the message, or [] if the viewer runs or the message was already returned.
        """
        if self._is_reported or self.is_open:
            return []
        self._is_reported = True
        return [self.wait_until_closed() or "the viewer was closed"]

    def wait_until_closed(self) -> str:
        """Wait until the viewer has ended.

        Returns:
            The error with which it ended, or "" if there was none.
        """
        if (status := self._process.wait()) == 0:
            return ""
        if status < 0:
            return f"the viewer was ended by {signal.Signals(-status).name}"
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        # If the viewer panicked, the cause precedes the stack trace in its output.
        panic = [line.partition(PANIC_TEXT)[2] for line in lines if PANIC_TEXT in line]
        return ": ".join([f"the viewer ended with status {status}", *(panic or lines[-1:])[:1]])

    def wait_for_end(self, bound_s: float) -> bool:
        """Wait for the viewer to end, for at most `bound_s`. Returns True if it has ended."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(bound_s)
        return not self.is_open

    @property
    def is_open(self) -> bool:
        """True while the viewer process runs."""
        return self._process.poll() is None

    def close(self) -> None:
        """End the viewer, if it still runs, and release what it has printed."""
        if self.is_open:
            # The command is a script that starts the viewer. Both are in its process group.
            os.killpg(self._process.pid, signal.SIGTERM)
            if not self.wait_for_end(ENDING_S):
                os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()
        self._said.close()


def open_window(port: int) -> Callable[[], list[str]]:
    """Open the viewer on a recorder's port.

    The returned function returns new messages of the viewer. If the viewer is missing, its only
    message is the reason.
    """
    try:
        return ViewerWindow(format_url(port)).read_notices
    except Failure as failure:
        news = [f"no viewer: {failure}"]
        return lambda: [news.pop()] if news else []


def has_screen() -> bool:
    """Return True if this session has a screen on which a window can be opened."""
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def find_executable() -> str:
    """Return the path of the viewer's executable. Raises `Failure` if it is not installed."""
    beside_python = Path(sys.executable).with_name("rerun")
    path = str(beside_python) if beside_python.is_file() else shutil.which("rerun")
    if path is None:
        raise Failure("the viewer 'rerun' is not installed; 'make run' installs it")
    return path


def find_free_port() -> int:
    """Return a TCP port of this machine that no program uses."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def format_url(port: int) -> str:
    """Return the URL of a recorder's stream, or of a viewer, on a port of this machine."""
    return f"rerun+http://{HOST}:{port}/proxy"
