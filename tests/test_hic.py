"""The rack hic, with real processes in lockstep: what boards read is as old as their places in the
schedule say."""

from __future__ import annotations

import os

import numpy as np
import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.boards import Rack
from rack.boards.config import load, wire
from rack.boards.config.timing import rack_timing
from rack.levels.systems.hand.messages import GraspKind
from rack.levels.timing.forecast import Forecast

SECONDS = 1.2
"""The fingers are closing by then."""


@pytest.mark.slow
def test_all_loops_drive_the_hand_with_tensions_of_one_age() -> None:
    with Rack(load("hic", [f"name=test-hic-{os.getpid()}", "clock.mode=lockstep"])) as rack:
        rack.run(SECONDS)
        commands, hand, grasp = (
            MailboxRing(rack.segment, name).drain().rows
            for name in ("tendon.command", "hand.status", "grasp.status")
        )
    sampled = commands["message"]["sampled"]
    assert np.unique((commands["tick"] - sampled)[sampled > 20]).tolist() == [3]
    statuses = hand["message"]
    assert statuses["tension"].min() >= 1.0
    assert not statuses["holding"][100:].any()
    assert statuses["touches"][-1] == statuses["violations"][-1] == 0
    assert GraspKind.CLOSE in grasp["message"]["kind"]


def test_every_board_has_its_place_in_its_frames() -> None:
    config = load("hic")
    found = Forecast.of(rack_timing(config, wire(config)))
    assert found.holds
    placed = {(alike.core, place.board) for alike in found.frames for place in alike.places}
    assert {board for _, board in placed} == set(config.board)
