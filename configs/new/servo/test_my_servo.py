"""Tests the servo law together with all levels in one process, without boards."""

from __future__ import annotations

from pathlib import Path

from rack.boards import OneProcess

CONFIG = Path(__file__).with_name("my_servo.toml")


def test_the_arm_follows_its_set_points() -> None:
    with OneProcess.from_file(CONFIG) as rack:
        rack.run(6.0)
        status = rack.newest("servo.status")
        assert abs(status.velocity).max() > 0.1
        assert abs(status.position - status.target).max() < 0.01
        assert (status.clipped, status.touches, status.violations, status.error) == (0, 0, 0, 0)
