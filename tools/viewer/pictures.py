"""Draws pictures of a recording with the viewer, without a screen."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from threading import Thread, Timer
from typing import NamedTuple

import numpy as np
from rerun.experimental import ViewerClient

from rack.tools.console.answer import Failure
from rack.tools.viewer.stream import SIM_TIME
from rack.tools.viewer.window import ViewerWindow, find_free_port, format_url

TIMEOUT_S = 30.0
POLL_S = 0.05
DYING_S = 2.0
"""Time to wait for a failing viewer to end.

Without a graphics driver, the viewer first listens on its port and then ends.
"""
PAUSE_S = 0.4
"""Time between two pictures. If both are equal, the viewer has finished drawing."""
QUIET_LEVELS = ("INFO", "DEBUG", "TRACE")
SOFTWARE = "Software rasterizer"
"""Part of a warning on a machine without a graphics card, which does not affect the picture."""
PACKAGES = (
    "mesa-vulkan-drivers",
    "libvulkan1",
    "libgl1-mesa-dri",
    "libegl1",
    "libxkbcommon0",
    "libxkbcommon-x11-0",
    "libx11-xcb1",
    "libxcursor1",
    "libxi6",
    "libxrandr2",
)
"""Debian packages that are needed to draw without a graphics card. .ci/run installs them."""


class NoViewerError(Failure):
    """Raised if this machine cannot draw pictures. The message says why, and what to install."""


class Picture(NamedTuple):
    """A picture, and the problems that the viewer reported while it drew the picture.

    Attributes:
        png: The picture in PNG format.
        complaints: Reports shown in the views, and warnings and errors in the viewer's log.
    """

    png: bytes
    complaints: tuple[str, ...]


class Screen:
    """A headless viewer that shows one recording. Created by `open_screen`."""

    def __init__(self, client: ViewerClient) -> None:
        self._client = client

    @property
    def views(self) -> dict[str, str]:
        """Dictionary from title to id of all views that the viewer shows."""
        return {view.name: view.view_id for view in self._client.get_state().views}

    def find_view(self, name: str) -> str:
        """Return the id of the view whose title contains a text: of the shortest such title.

        Raises:
            Failure: No view has such a title. The message lists all titles.
        """
        views = self.views
        found = [title for title in views if name.lower() in title.lower()]
        if not found:
            raise Failure(f"--view {name}: no such view: {'; '.join(views)}", 2)
        return views[min(found, key=len)]

    def take_picture(self, at_s: float, view: str | None = None) -> Picture:
        """Go to a simulated time, wait until the picture no longer changes, and return it.

        Args:
            at_s: The simulated time in s.
            view: Title of the only view to draw, or a part of it. By default all views are drawn.

        Raises:
            Failure: No view has that title.
        """
        view_id = None if view is None else self.find_view(view)
        self._client.set_time(
            SIM_TIME, duration=np.timedelta64(round(at_s * 1e9), "ns"), play_state="paused"
        )
        drawn = b""
        deadline = time.monotonic() + TIMEOUT_S
        while time.monotonic() < deadline:
            time.sleep(PAUSE_S)
            before = drawn
            drawn = bytes(self._client.take_screenshot(view_id))
            if drawn == before:
                break
        return Picture(drawn, tuple(self._list_complaints()))

    def _list_complaints(self) -> Iterator[str]:
        """Yield the reports shown in all views, and the warnings and errors in the viewer's log."""
        for view in self._client.get_state().views:
            yield from (f"view '{view.name}': {report}" for report in view.reports)
        for entry in self._client.get_logs():
            if entry.level.upper() not in QUIET_LEVELS and SOFTWARE not in entry.message:
                yield f"{entry.level.lower()}: {entry.message}"


@contextmanager
def open_screen(*recordings: Path) -> Iterator[Screen]:
    """Open the files of a recording in a headless viewer, which is closed with the context.

    Raises:
        NoViewerError: The viewer does not run, for example because graphics libraries are missing,
            or it ends while it is used.
    """
    port = find_free_port()
    # `ViewerClient.spawn` would start a viewer that listens on every network.
    window = ViewerWindow(headless=True, port=port)
    # Calls of the client do not return if the viewer hangs.
    watchdog = Timer(3.0 * TIMEOUT_S, window.end)
    watchdog.start()
    try:
        client = _connect_client(window, port)
        for recording in recordings:
            client.open(str(recording.resolve()))
        yield Screen(client)
    except (ConnectionError, RuntimeError) as error:
        raise NoViewerError(_explain_failure(window, error)) from None
    finally:
        watchdog.cancel()
        window.close()


def draw_picture(recordings: Sequence[Path], at_s: float, view: str | None) -> Picture:
    """Draw a picture in a thread, because calls of the client block signals.

    Args:
        recordings: Files of the recording.
        at_s: The simulated time in s.
        view: Title of the only view to draw, or a part of it. None for all views.

    Raises:
        Failure: The viewer does not run, or has no such view.
    """
    answers = SimpleQueue[Picture | Exception]()

    def draw() -> None:
        """Put the picture, or the error, into the queue."""
        try:
            with open_screen(*recordings) as screen:
                answers.put(screen.take_picture(at_s, view))
        except Exception as error:
            answers.put(error)

    Thread(target=draw, daemon=True).start()
    answer = answers.get()
    if isinstance(answer, Exception):
        raise answer
    return answer


def _connect_client(window: ViewerWindow, port: int) -> ViewerClient:
    """Connect to a viewer as soon as it listens on the port.

    Raises:
        NoViewerError: The viewer ended, or does not listen within `TIMEOUT_S`.
    """
    deadline = time.monotonic() + TIMEOUT_S
    while window.is_open and time.monotonic() < deadline:
        if window.is_listening(port):
            return ViewerClient.connect(format_url(port))
        time.sleep(POLL_S)
    why = f"the viewer did not listen on port {port} within {TIMEOUT_S:g} s"
    raise NoViewerError(_explain_failure(window, why))


def _explain_failure(window: ViewerWindow, otherwise: object) -> str:
    """Return the reason why no picture can be drawn, and which packages to install.

    Args:
        window: The viewer. If it has ended with an error, that error is the reason.
        otherwise: The reason to return in any other case.
    """
    reason = otherwise
    if window.wait_for_end(DYING_S):
        reason = window.wait_until_closed() or "the viewer ended without an error"
    return "; ".join(filter(None, (str(reason), describe_missing_packages())))


def describe_missing_packages() -> str:
    """Return a clause that names the packages missing for drawing without a graphics card.

    Empty if none is missing.
    """
    if shutil.which("dpkg-query") is None:
        return f"without a graphics card, these Debian packages are needed: {' '.join(PACKAGES)}"
    query = ["dpkg-query", "--show", "--showformat", "${Package} ${Status}\\n", *PACKAGES]
    installed = subprocess.run(query, capture_output=True, text=True, check=False).stdout
    missing = [name for name in PACKAGES if f"{name} install ok installed" not in installed]
    return f"missing packages: apt-get install {' '.join(missing)}" if missing else ""
