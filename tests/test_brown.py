"""The rack brown on one machine, with real processes in lockstep: a law is replaced in motion, the
general machine is silent."""

from __future__ import annotations

import os
from typing import NamedTuple

import numpy as np
import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.boards import Rack
from rack.boards.config import load

SECONDS = 2.0
LOST = """
[[fault]]
kind = "mute"
board = "trajectory"
mailbox = "trajectory.command"
at = 1.5
for = 0.1
"""
"""The general machine is silent for ten references."""


class Ran(NamedTuple):
    """The mailboxes of a run, by name."""

    boxes: dict[str, np.ndarray]

    def values(self, mailbox: str, field: str, first: int, last: int) -> np.ndarray:
        """Return a field of the messages from one tick to another."""
        rows = self.boxes[mailbox]
        return np.asarray(rows["message"][field][(rows["tick"] >= first) & (rows["tick"] <= last)])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    script = tmp_path_factory.mktemp("brown") / "lost.toml"
    script.write_text(LOST)
    settings = [f"name=test-brown-{os.getpid()}", "clock.mode=lockstep"]
    with Rack(load("brown/one-machine", settings, str(script))) as rack:
        rack.run(SECONDS)
        names = "arm.status", "shoulder.status", "supervisor.status", "supervisor.command"
        return Ran({name: MailboxRing(rack.segment, name).drain().rows for name in names})


@pytest.mark.slow
def test_the_law_is_replaced_on_two_boards_in_motion_without_a_step(run: Ran) -> None:
    assert run.values("shoulder.status", "reason", 1200, 1201).tolist() == [b"", b"modified by pd"]
    assert np.abs(run.values("arm.status", "target_velocity", 1200, 1200)).max() > 0.5
    steps = np.abs(np.diff(run.values("arm.status", "torque", 300, 1499), axis=0))
    # From brakes to motion and at the blend, against the second after the switch.
    assert steps[900:].max() < steps[:900].max()
    assert np.abs(
        np.diff(run.values("shoulder.status", "torque", 1200, 1201), axis=0)
    ).max() == pytest.approx(0.0)


@pytest.mark.slow
def test_a_silent_general_machine_is_bridged_then_the_arm_holds_and_goes_on(run: Ran) -> None:
    due = run.values("supervisor.command", "due", 1400, 1999)
    assert (due == 0).any()
    last = due[np.argmax(due == 0) - 1]
    reasons = set(run.values("supervisor.status", "reason", 1500, 1700).tolist())
    assert b"no reference from 'trajectory': held after 5 extrapolated" in reasons
    assert 1500 < last < 1650
    moving = np.abs(run.values("arm.status", "target_velocity", 1990, 1999)).max()
    assert moving > 0.01
    assert not run.values("arm.status", "braked", 1400, 1999).any()
