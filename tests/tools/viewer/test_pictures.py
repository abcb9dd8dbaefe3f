"""Pictures without a screen: the viewer's network access, and a viewer that fails."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from rack.tools.viewer.pictures import _connect_client
from rack.tools.viewer.window import ViewerWindow, find_free_port

LOOPBACK, LISTENS = "0100007F", "0A"


def test_the_viewer_listens_to_this_machine_alone() -> None:
    port = find_free_port()
    window = ViewerWindow(headless=True, port=port)
    try:
        _connect_client(window, port)
        sockets = [
            line.split()[1:4]
            for name in ("tcp", "tcp6")
            for line in Path("/proc/net", name).read_text().splitlines()
        ]
        found = [
            place
            for place, _, state in sockets
            if place.endswith(f":{port:04X}") and state == LISTENS
        ]
    except ConnectionError as error:
        pytest.skip(str(error))
    finally:
        window.close()
    assert found == [f"{LOOPBACK}:{port:04X}"]


@pytest.mark.slow
def test_a_viewer_that_is_killed_while_it_draws_is_reported() -> None:
    port = find_free_port()
    window = ViewerWindow(headless=True, port=port)
    try:
        _connect_client(window, port)
        os.killpg(window._process.pid, signal.SIGKILL)
        assert window.wait_until_closed() == "the viewer was ended by SIGKILL"
    except ConnectionError as error:
        pytest.skip(str(error))
    finally:
        window.close()
