"""How a board waits for its cycle: a semaphore, or busy-waiting on its own core."""

from __future__ import annotations

import os

import pytest

from rack.backplane.layout import PROTOCOLS, Protocol
from rack.backplane.words import Block
from rack.boards import Rack
from tests.boards.conftest import PLAIN, MakeConfig
from tests.boards.messages import Written

SECONDS = 0.25
TICKS = 100
POLL = "board.wave.wake=poll"
pytestmark = pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="a polling board needs its own core")


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_polling_board_writes_the_same_as_a_woken_one(config: MakeConfig, protocol: Protocol) -> None:
    digests = set()
    for wake in ("board.wave.wake=signal", POLL):
        with Rack(config(wake, f"protocol.default={protocol}", text=PLAIN)) as rack:
            digests.add(rack.run(SECONDS).digest)
    assert len(digests) == 1


def test_a_board_that_polls_keeps_the_grid_in_real_time(config: MakeConfig) -> None:
    with Rack(config(POLL, "clock.mode=realtime", "clock.speed=0.5", text=PLAIN)) as rack:
        assert rack.run(SECONDS).ticks == TICKS
        block = rack.segment.block("wave")
        # A board whose core was taken away during the very last cycles does not see those any more.
        assert TICKS - 8 <= block[Block.CYCLES] + block[Block.SKIPPED] <= TICKS
        cycles = Written.on(rack.segment).cycles["wave"]
    assert (cycles["start_ns"] >= cycles["release_ns"]).all()
