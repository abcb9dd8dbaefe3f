"""Tests the level together with all other levels in one process, without boards."""

from __future__ import annotations

from pathlib import Path

from rack.boards import OneProcess

CONFIG = Path(__file__).with_name("my_level.toml")


def test_it_sees_the_arm_move() -> None:
    with OneProcess.from_file(CONFIG) as rack:
        rack.run(1.0)
        assert rack.newest("my_level.status").speed < 0.01
        rack.run(5.0)
        assert rack.newest("my_level.status").speed > 0.1
