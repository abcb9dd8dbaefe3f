"""Tests executor and planner together with all other levels in one process, without boards."""

from __future__ import annotations

from pathlib import Path

from rack.boards import OneProcess

CONFIG = Path(__file__).with_name("my_planner.toml")


def test_motion_takes_more_torque_than_rest() -> None:
    with OneProcess.from_file(CONFIG) as rack:
        rack.run(1.0)
        assert abs(rack.newest("my_planner.plan").gravity).max() > 1.0
        assert rack.newest("my_planner.status").moving < 0.1
        rack.run(5.0)
        assert rack.newest("my_planner.status").moving > 1.0
