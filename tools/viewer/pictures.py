"""Draws pictures of a recording without a screen.

Usage: `python -m rack.tools.viewer.pictures RUN/run.rrd OUT.png --at 7.5`.
"""

from __future__ import annotations

import argparse
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rerun.experimental import ViewerClient

from rack.tools.console.answer import Failure
from rack.tools.viewer.stream import SIM_TIME
from rack.tools.viewer.window import HOST, ViewerWindow, find_free_port, format_url

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
        """Dictionary from name to id of all views that the viewer shows."""
        return {view.name: view.view_id for view in self._client.get_state().views}

    def take_picture(self, at_s: float, view: str | None = None) -> Picture:
        """Go to a simulated time, wait until the picture no longer changes, and return it.

        Args:
            at_s: The simulated time in s.
            view: Name of the only view to draw. By default all views are drawn.

        Raises:
            KeyError: No view has that name.
        """
        view_id = None if view is None else self.views[view]
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
def open_screen(recording: Path) -> Iterator[Screen]:
    """Open a recording in a headless viewer, which is closed at the end of the context.

    Raises:
        NoViewerError: The viewer does not run, for example because graphics libraries are missing.
    """
    port = find_free_port()
    # `ViewerClient.spawn` would start a viewer that listens on every network.
    window = ViewerWindow(headless=True, port=port)
    try:
        client = _connect_client(window, port)
        try:
            client.open(str(recording.resolve()))
        except (ConnectionError, RuntimeError) as error:
            raise NoViewerError(_explain_failure(window, error)) from None
        yield Screen(client)
    finally:
        window.close()


def _connect_client(window: ViewerWindow, port: int) -> ViewerClient:
    """Connect to a viewer as soon as it listens on the port.

    Raises:
        NoViewerError: The viewer ended, or does not listen within `TIMEOUT_S`.
    """
    deadline = time.monotonic() + TIMEOUT_S
    while window.is_open and time.monotonic() < deadline:
        with socket.socket() as probe:
            if probe.connect_ex((HOST, port)) == 0:
                return ViewerClient.connect(format_url(port))
        time.sleep(POLL_S)
    raise NoViewerError(
        _explain_failure(window, f"the viewer did not listen within {TIMEOUT_S:g} s")
    )


def _explain_failure(window: ViewerWindow, otherwise: object) -> str:
    """Return the reason why no picture can be drawn, and which packages to install.

    Args:
        window: The viewer. If it has ended with an error, that error is the reason.
        otherwise: The reason to return in any other case.
    """
    reason = window.wait_until_closed() if window.wait_for_end(DYING_S) else otherwise
    return f"{reason}; {describe_missing_packages()}"


def describe_missing_packages() -> str:
    """Return a clause that names the packages missing for drawing without a graphics card."""
    if shutil.which("dpkg-query") is None:
        return f"without a graphics card, these Debian packages are needed: {' '.join(PACKAGES)}"
    query = ["dpkg-query", "--show", "--showformat", "${Package} ${Status}\\n", *PACKAGES]
    installed = subprocess.run(query, capture_output=True, text=True, check=False).stdout
    missing = [name for name in PACKAGES if f"{name} install ok installed" not in installed]
    if not missing:
        return "no package for drawing is missing"
    return f"missing packages: apt-get install {' '.join(missing)}"


def main() -> int:
    """Save one picture, and print the problems that the viewer reported.

    Returns:
        The exit status: 0, 1 if the viewer reported problems, or the status of a failure.
    """
    parser = argparse.ArgumentParser(
        prog="python -m rack.tools.viewer.pictures", description=__doc__
    )
    parser.add_argument("recording", type=Path, help="a run.rrd")
    parser.add_argument("out", type=Path, help="PNG file to write")
    parser.add_argument(
        "--at", type=float, required=True, metavar="S", help="simulated time to look at, s"
    )
    parser.add_argument("--view", metavar="NAME", help="draw only the view with this title")
    options = parser.parse_args()
    try:
        with open_screen(options.recording) as screen:
            look = screen.take_picture(options.at, options.view)
    except Failure as failure:
        print(failure, file=sys.stderr)
        return failure.status
    options.out.write_bytes(look.png)
    for complaint in look.complaints:
        print(complaint, file=sys.stderr)
    return 1 if look.complaints else 0


if __name__ == "__main__":
    sys.exit(main())
