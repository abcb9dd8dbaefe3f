"""How a board waits for its cycle: on the grid by itself, on a semaphore, or busy-waiting on its
own core."""

from __future__ import annotations

import os
from typing import get_args

import pytest

from rack.backplane.layout import Wake
from rack.backplane.words import Block
from rack.boards import Rack
from tests.boards.conftest import PLAIN, MakeConfig
from tests.boards.messages import Written

SECONDS = 0.25
TICKS = 100
pytestmark = pytest.mark.skipif(
    len(os.sched_getaffinity(0)) < 2, reason="a polling board needs its own core"
)


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["time-slice", "lock"])
def test_boards_write_the_same_however_they_wait(config: MakeConfig, protocol: str) -> None:
    digests = set()
    for wake in get_args(Wake):
        with Rack(
            config(f"board.wave.wake={wake}", f"protocol.default={protocol}", text=PLAIN)
        ) as rack:
            digests.add(rack.run(SECONDS).digest)
    assert len(digests) == 1


@pytest.mark.slow
@pytest.mark.parametrize("wake", get_args(Wake))
def test_a_board_keeps_the_grid_in_real_time(config: MakeConfig, wake: Wake) -> None:
    with Rack(
        config(f"board.wave.wake={wake}", "clock.mode=realtime", "clock.speed=0.5", text=PLAIN)
    ) as rack:
        assert rack.run(SECONDS).ticks == TICKS
        block = rack.segment.block("wave")
        # A board whose core was taken away during the very last cycles does not see those any more.
        assert TICKS - 8 <= block[Block.CYCLES] + block[Block.SKIPPED] <= TICKS
        cycles = Written.on(rack.segment).cycles["wave"]
    assert (cycles["start_ns"] >= cycles["release_ns"]).all()
