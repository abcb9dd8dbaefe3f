"""Pictures without a screen: the viewer's network access, and a viewer that fails."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from rack.tools.viewer.pictures import _connect_client
from rack.tools.viewer.window import ViewerWindow, find_free_port

LOOPBACK, LISTENS = "0100007F", "0A"


@contextmanager
def headless_window() -> Iterator[tuple[ViewerWindow, int]]:
    """Open a viewer, and yield it and its port. Without a driver the test is skipped."""
    port = find_free_port()
    window = ViewerWindow(headless=True, port=port)
    try:
        _connect_client(window, port)
        yield window, port
    except ConnectionError as error:
        pytest.skip(str(error))
    finally:
        window.close()


def test_the_viewer_listens_to_this_machine_alone() -> None:
    with headless_window() as (_, port):
        sockets = [
            line.split()[1:4]
            for name in ("tcp", "tcp6")
            for line in Path("/proc/net", name).read_text().splitlines()
        ]
    at_port = f":{port:04X}"
    found = [place for place, _, state in sockets if place.endswith(at_port) and state == LISTENS]
    assert found == [f"{LOOPBACK}{at_port}"]


@pytest.mark.slow
def test_a_viewer_that_is_killed_while_it_draws_is_reported() -> None:
    with headless_window() as (window, _):
        os.killpg(window._process.pid, signal.SIGKILL)
        assert window.wait_until_closed() == "the viewer was ended by SIGKILL"
