"""The rack condor, with real processes in lockstep: the workstation plans the grasp, the boards
grasp."""

from __future__ import annotations

import os

import numpy as np
import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.message import Message
from rack.boards import Rack
from rack.boards.config import load
from rack.levels.systems.hand.messages import GraspKind
from tests.processes import wait_until

pytestmark = pytest.mark.slow


def test_an_order_of_the_workstation_comes_to_the_fingers_as_interrupts() -> None:
    settings = [f"name=test-condor-{os.getpid()}", "clock.mode=lockstep"]
    with Rack(load("condor", settings)) as rack:
        rack.start()
        grasp = open_observer(rack.segment, "coordinator.status")

        def status() -> Message:
            rack.watch(0.02)
            return grasp.peek().message

        wait_until(lambda: status().kind == GraspKind.CLOSE)
        assert status().plan == 1
        rack.stop("seen enough")
        plan = open_observer(rack.segment, "adapter.plan").peek().message
        tensions = [
            MailboxRing(rack.segment, f"{finger}.command").read_new_rows().rows
            for finger in ("index", "thumb")
        ]
    # Each finger is on its side of the can, and both sensed the hand a tick before they commanded.
    assert (plan.normal[:3] * plan.normal[3]).sum(axis=1).max() < -0.99
    for rows in tensions:
        sampled = rows["message"]["sampled"]
        assert np.unique((rows["tick"] - sampled)[sampled > 20]).tolist() == [1]
