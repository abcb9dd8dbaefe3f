"""Pictures of a recording without a screen: `python -m tools.viewer.pictures RUN/run.rrd OUT.png --at 7.5`."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rerun.experimental import ViewerClient

from tools.viewer.timelines import SIM_TIME
from tools.viewer.window import executable, free_port

PATIENCE_S = 30.0
PAUSE_S = 0.4
"""Two pictures this far apart that are the same: the viewer has drawn all it has."""
NO_COMPLAINT = ("INFO", "DEBUG", "TRACE")
SOFTWARE = "Software rasterizer"
"""What the viewer remarks where there is no graphics card; it draws all the same."""


class Look(NamedTuple):
    """A picture (PNG) as it was drawn, and what the viewer complained of, in its views and in its log."""

    picture: bytes
    complaints: tuple[str, ...]


class Screen:
    """A headless viewer that shows one recording; see `opened`."""

    def __init__(self, client: ViewerClient) -> None:
        self._client = client

    def look(self, at_s: float, view: str | None = None) -> Look:
        """Return what is to be seen at a simulated time, s, once it stands still: all, or the view of that name.

        Raises `KeyError` when there is no such view.
        """
        shown = None if view is None else {v.name: v.view_id for v in self._client.get_state().views}[view]
        self._client.set_time(SIM_TIME, duration=np.timedelta64(round(at_s * 1e9), "ns"), play_state="paused")
        drawn, deadline = b"", time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            time.sleep(PAUSE_S)
            before, drawn = drawn, bytes(self._client.take_screenshot(shown))
            if drawn == before:
                break
        return Look(drawn, tuple(self._complaints()))

    def _complaints(self) -> Iterator[str]:
        for view in self._client.get_state().views:
            yield from (f"view '{view.name}': {report}" for report in view.reports)
        for entry in self._client.get_logs():
            if entry.level.upper() not in NO_COMPLAINT and SOFTWARE not in entry.message:
                yield f"{entry.level.lower()}: {entry.message}"


@contextmanager
def opened(recording: Path) -> Iterator[Screen]:
    """Open a recording in a headless viewer. Raises `RuntimeError` where the machine lacks the graphics libraries."""
    spawned = ViewerClient.spawn(
        headless=True, port=free_port(), hide_welcome_screen=True, executable_path=executable()
    )
    with spawned as client:
        client.open(str(recording.resolve()))
        yield Screen(client)


def main() -> int:
    """Save one picture; return 1 when the viewer complained of anything."""
    parser = argparse.ArgumentParser(prog="python -m tools.viewer.pictures", description=__doc__)
    parser.add_argument("recording", type=Path, help="a run.rrd")
    parser.add_argument("out", type=Path, help="PNG file to write")
    parser.add_argument("--at", type=float, required=True, metavar="S", help="simulated time to look at, s")
    parser.add_argument("--view", metavar="NAME", help="one view alone, as its title says")
    given = parser.parse_args()
    with opened(given.recording) as screen:
        look = screen.look(given.at, given.view)
    given.out.write_bytes(look.picture)
    for complaint in look.complaints:
        print(complaint, file=sys.stderr)
    return 1 if look.complaints else 0


if __name__ == "__main__":
    sys.exit(main())
