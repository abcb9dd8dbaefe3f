"""Draws pictures of a recording with the viewer, without a screen."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rerun.experimental import ViewerClient

from rack.tools.console.answer import Failure
from rack.tools.viewer.stream import SIM_TIME
from rack.tools.viewer.window import ViewerWindow, find_free_port, format_url

TIMEOUT_S = 30.0
LONGEST_S = 90.0
"""Time after which a viewer that does not answer is ended."""
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
    complaints: list[str]


def draw_picture(recordings: Sequence[Path], at_s: float, view: str | None = None) -> Picture:
    """Draw a recording with a viewer that opens no window.

    Args:
        recordings: Files of the recording.
        at_s: The simulated time in s.
        view: Title of the only view to draw, or a part of it. None for all views.

    Raises:
        NoViewerError: The viewer does not run, for example because graphics libraries are missing,
            or it ends while it is used.
        Failure: No view has such a title. The message lists all titles.
    """
    port = find_free_port()
    # Use a thread, because calls of the client block signals. Closing the viewer ends its calls.
    # `ViewerClient.spawn` would start a viewer that listens on every network.
    with (
        ThreadPoolExecutor() as pool,
        closing(ViewerWindow(headless=True, port=port)) as window,
    ):
        try:
            return pool.submit(_draw, window, port, recordings, at_s, view).result(LONGEST_S)
        except (ConnectionError, RuntimeError, TimeoutError) as error:
            raise NoViewerError(f"no picture: {_explain_failure(window, error)}") from None


def _draw(
    window: ViewerWindow, port: int, recordings: Sequence[Path], at_s: float, view: str | None
) -> Picture:
    """Draw a recording with the viewer that listens on a port. See `draw_picture`."""
    client = _connect_client(window, port)
    client.open([str(recording.resolve()) for recording in recordings])
    view_id = None
    if view is not None:
        views = {shown.name: shown.view_id for shown in client.get_state().views}
        found = [title for title in views if view.lower() in title.lower()]
        if not found:
            raise Failure(f"--view {view}: no such view: {'; '.join(views)}", 2)
        view_id = views[min(found, key=len)]
        # Only then is a view drawn that is in a tab behind another one.
        blueprint = client.get_blueprint().blueprint
        blueprint["/viewport"]["ViewportBlueprint"]["maximized"] = view_id
        client.set_blueprint(blueprint, "recording")
    client.set_time(SIM_TIME, duration=np.timedelta64(round(at_s * 1e9), "ns"), play_state="paused")
    drawn, before = b"", None
    deadline = time.monotonic() + TIMEOUT_S
    # Wait until the picture no longer changes.
    while drawn != before and time.monotonic() < deadline:
        time.sleep(PAUSE_S)
        before = drawn
        drawn = client.take_screenshot(view_id)
    complaints = [
        f"view '{shown.name}': {report}"
        for shown in client.get_state().views
        for report in shown.reports
    ]
    complaints += [
        f"{entry.level.lower()}: {entry.message}"
        for entry in client.get_logs()
        if entry.level.upper() not in QUIET_LEVELS and SOFTWARE not in entry.message
    ]
    return Picture(drawn, complaints)


def _connect_client(window: ViewerWindow, port: int) -> ViewerClient:
    """Connect to a viewer as soon as it listens on the port.

    Raises:
        ConnectionError: The viewer ended, or does not listen within `TIMEOUT_S`.
    """
    deadline = time.monotonic() + TIMEOUT_S
    while window.is_open and time.monotonic() < deadline:
        with suppress(ConnectionError):
            return ViewerClient.connect(format_url(port))
        time.sleep(POLL_S)
    raise ConnectionError(f"the viewer did not listen on port {port} within {TIMEOUT_S:g} s")


def _explain_failure(window: ViewerWindow, error: Exception) -> str:
    """Return the reason why no picture can be drawn, and which packages to install.

    Args:
        window: The viewer. If it has ended, the reason is its own error.
        error: The reason otherwise.
    """
    reason = str(error).partition("\n")[0] or f"the viewer did not answer within {LONGEST_S:g} s"
    if window.wait_for_end(DYING_S):
        reason = window.wait_until_closed() or "the viewer ended without an error"
    return "; ".join(filter(None, (reason, describe_missing_packages())))


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
