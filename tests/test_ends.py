"""Runs in lockstep whose tasks never end come to an end by themselves, and state why."""

from __future__ import annotations

import pytest

from rack.boards import Rack
from rack.boards.config import load

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("config", "settings", "reason"),
    [
        (
            # The link is slower than the handover permits: the boards follow and hold by turns.
            "brown/three-poses",
            ("board.supervisor.params.delay=0.02", "board.trajectory.params.stalled=0.4"),
            "request 1: waited for 0.4 s: waiting for supervisor: it ",
        ),
        (
            "nist-state-table",
            ("supervision.lockstep_end_s=0.5",),
            "'task.status' has been neither done nor error for 0.5 s, the limit"
            " supervision.lockstep_end_s",
        ),
    ],
)
def test_a_run_whose_task_cannot_end_fails_with_a_reason(
    config: str, settings: tuple[str, ...], reason: str, rack_name: str
) -> None:
    with Rack(load(config, [f"name={rack_name}", "clock.mode=lockstep", *settings])) as rack:
        outcome = rack.run()
    assert outcome.cause == "task failed"
    assert outcome.reason.startswith(reason)
