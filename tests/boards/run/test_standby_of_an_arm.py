"""The standby of nasrem's servo level: the arm moves as if nothing had happened."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.boards import Rack
from rack.boards.config import load
from rack.boards.config.schema import RackConfig
from rack.boards.events import Event
from tests.boards.runs import faulty, kill

pytestmark = [pytest.mark.slow, pytest.mark.thorough]
SECONDS = 6.75
"""The first path is planned, and part of it driven."""
STANDBY = ("board.servo.standby={slot=9,core=0}", "board.servo.compare=true")
FIRST, SECOND = 2300, 2600
CASES: Mapping[str, tuple[Mapping[str, Any], ...]] = {
    "no fault": (),
    "two kills": (kill("servo", FIRST), kill("servo.standby", SECOND)),
    "a hang": ({"kind": "hang", "board": "servo", "tick": FIRST},),
}


def run(config: RackConfig) -> tuple[str, list[Event], np.ndarray]:
    """Return digest, events and the newest states of the arm."""
    with Rack(config) as rack:
        outcome = rack.run(SECONDS)
        return (
            outcome.digest,
            rack.events,
            MailboxRing(rack.segment, "servo.state").read_new_rows().rows,
        )


@pytest.fixture(scope="module")
def plain() -> str:
    return run(load("nasrem", ["clock.mode=lockstep", "name=test-plain-arm"]))[0]


@pytest.mark.parametrize("case", CASES)
def test_the_digest_is_that_without_standby_and_without_faults(
    case: str, rack_name: str, plain: str
) -> None:
    config = load("nasrem", ["clock.mode=lockstep", f"name={rack_name}", *STANDBY])
    digest, events, states = run(faulty(config, *CASES[case]))
    assert digest == plain
    assert not [event for event in events if event.code in ("brakes_closed", "demand", "differs")]
    assert states["tick"][0] < FIRST
    assert (np.diff(states["tick"]) == 1).all()
    assert not states["message"]["braked"].any()
    # The arm moves in both hand-overs.
    speed = np.abs(states["message"]["velocity"]).max(axis=1)
    for tick in (FIRST, SECOND):
        assert speed[states["tick"] == tick] > 0.01
