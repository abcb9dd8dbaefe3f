"""Pushes: forces on objects by simulated time, the same in every run and after a restart."""

from __future__ import annotations

import numpy as np
import pytest

from rack.levels.arm import SimulatedArm
from rack.levels.arm.simulation import compute_push_force
from rack.levels.messages import ArmState
from rack.levels.robot.cell import build_cell, compute_sizes
from rack.levels.tables import PushConfig
from tests.levels.arms import CLOCK_NS, config

UP = PushConfig(body="peg", at=1.0, seconds=0.5, force=(0.0, 0.0, 4.0), rise=0.2)


def pushed_arm(*pushes: PushConfig) -> SimulatedArm:
    robot, scene = config("puma560")
    scene = scene.model_copy(update={"push": pushes})
    return SimulatedArm(build_cell(robot, scene, CLOCK_NS), scene, CLOCK_NS)


@pytest.mark.parametrize(
    ("time_s", "part"),
    [(0.99, 0.0), (1.0, 0.0), (1.1, 0.5), (1.2, 1.0), (1.3, 1.0), (1.45, 0.25), (1.5, 0.0)],
)
def test_a_push_rises_lasts_and_falls(time_s: float, part: float) -> None:
    assert compute_push_force((UP,), time_s) == pytest.approx([0.0, 0.0, 4.0 * part])
    aside = PushConfig(body="peg", at=0.5, seconds=2.0, force=(1.0, 0.0, 0.0))
    assert compute_push_force((UP, aside), time_s) == pytest.approx([1.0, 0.0, 4.0 * part])


def test_an_arm_restored_during_a_push_continues_bit_for_bit() -> None:
    states = [ArmState.zeros(compute_sizes(pushed_arm().cell)) for _ in range(3)]
    arm = pushed_arm(
        PushConfig(body="block2", at=0.02, seconds=0.2, force=(1.5, 0.5, 0.3), rise=0.1)
    )
    arm.step(25)
    arm.save(states[0])
    arm.step(40)
    arm.save(states[1])
    again = pushed_arm(
        PushConfig(body="block2", at=0.02, seconds=0.2, force=(1.5, 0.5, 0.3), rise=0.1)
    )
    again.restore(states[0])
    again.step(40)
    again.save(states[2])
    assert states[2].raw == states[1].raw
    assert not np.array_equal(states[0].state, states[1].state)
