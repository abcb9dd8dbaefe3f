"""`clock.idle_cores`: a rack leaves idle cores alone unless it is asked to hold them awake, and
says so at launch."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rack.backplane.process import LATENCY_REQUEST
from rack.backplane.words import System
from rack.boards import Rack
from tests.boards.conftest import MakeConfig
from tests.processes import named, wait_until

pytestmark = pytest.mark.slow

needs_request = pytest.mark.skipif(
    not os.access(LATENCY_REQUEST, os.W_OK), reason="needs root, for the request"
)
AWAKE = "clock.idle_cores=awake"


def holders(rack: Rack) -> list[str]:
    """Return which of a rack's processes hold the request open; "clock" is the clock's."""
    found = []
    for pid in named(f"{rack.config.name}:"):
        if LATENCY_REQUEST in [one.readlink() for one in Path(f"/proc/{pid}/fd").iterdir()]:
            found.append("clock" if pid == rack.segment.words[System.CLOCK_PID] else str(pid))
    return found


def held_in(rack: Rack) -> tuple[list[str], list[str]]:
    """Return who holds the request while a rack runs, and what its launch said of idle cores."""
    with rack:
        rack.start(20.0)
        wait_until(lambda: rack.watch(0.01) and rack.segment.words[System.TICK] > 2)
        assert len(named(f"{rack.config.name}:")) >= len(rack.segment.layout.tasks) + 1
        held = holders(rack)
        rack.stop("seen enough")
        while rack.watch(0.05):
            continue
    return held, [event.text for event in rack.events if "idle" in event.text]


@needs_request
def test_a_rack_that_is_asked_to_holds_idle_cores_awake_and_says_so(config: MakeConfig) -> None:
    held, notes = held_in(Rack(config("clock.mode=realtime", AWAKE), share=True))
    assert held == ["clock"]
    assert notes == ['clock.idle_cores = "awake": idle cores are held awake']
