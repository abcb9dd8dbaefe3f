"""The rack hic, with real processes in lockstep: what boards read is as old as their places in the
schedule say."""

from __future__ import annotations

import os
from typing import NamedTuple

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


class Grasp(NamedTuple):
    """A run: its digest, and its mailboxes by name."""

    digest: str
    boxes: dict[str, np.ndarray]


def ran() -> Grasp:
    with Rack(load("hic", [f"name=test-hic-{os.getpid()}", "clock.mode=lockstep"])) as rack:
        digest = rack.run(SECONDS).digest
        names = "tendon.command", "hand.status", "grasp.status"
        return Grasp(digest, {name: MailboxRing(rack.segment, name).drain().rows for name in names})


@pytest.fixture(scope="module")
def run() -> Grasp:
    return ran()


@pytest.mark.slow
def test_all_loops_drive_the_hand_with_tensions_of_one_age(run: Grasp) -> None:
    commands = run.boxes["tendon.command"]
    sampled = commands["message"]["sampled"]
    assert np.unique((commands["tick"] - sampled)[sampled > 20]).tolist() == [3]
    statuses = run.boxes["hand.status"]["message"]
    assert statuses["tension"].min() >= 1.0
    assert not statuses["holding"][100:].any()
    assert statuses["touches"][-1] == statuses["violations"][-1] == 0
    assert GraspKind.CLOSE in run.boxes["grasp.status"]["message"]["kind"]


@pytest.mark.slow
def test_a_run_of_buffers_without_locks_repeats_bit_for_bit(run: Grasp) -> None:
    assert ran().digest == run.digest


def test_every_board_has_its_place_in_its_frames() -> None:
    config = load("hic")
    found = Forecast.of(rack_timing(config, wire(config)))
    assert found.holds
    placed = {(alike.core, place.board) for alike in found.frames for place in alike.places}
    assert {board for _, board in placed} == set(config.board)
