"""The primitive level when a board dies, starts anew, misses cycles or falls silent, or the arm does not follow."""

from __future__ import annotations

import numpy as np
import pytest

from levels.messages import Error
from tests.levels.primitive_rack import PrimitiveRack, gripper, path

TURN = np.array([0.6, -0.1, 0.2, 0.0, 0.1, 0.3])
BEND = np.array([0.3, 0.0, 0.0, 0.4, 0.0, -0.3])


def two_paths(rack: PrimitiveRack) -> tuple:
    a, b = rack.home + TURN, rack.home + BEND
    return path(1, [rack.home, a]), path(2, [a, b, rack.home], [0.0, 0.2, 0.0])


def test_arm_that_does_not_follow_is_an_error_and_comes_to_rest() -> None:
    rack = PrimitiveRack(params={"following": 1e-6})
    rack.command(path(1, [rack.home, rack.home + TURN]))
    status = rack.run_until_error()
    assert status.error == Error.FOLLOWING
    assert "from its set point" in status.reason
    rack.run(1.0)
    assert rack.status.resting
    assert rack.status.done == 0


@pytest.mark.parametrize(("died_at_s", "away_s"), [(0.05, 0.25), (0.3, 0.0), (0.9, 0.04), (1.2, 0.25)])
def test_executor_that_starts_anew_finishes_what_was_under_way(died_at_s: float, away_s: float) -> None:
    rack = PrimitiveRack()
    rack.command(*two_paths(rack))
    rack.run(died_at_s)
    rack.tasks["primitive"].due = -1
    rack.run(away_s)
    rack.restart("primitive")
    assert rack.run_until_done(2)
    assert np.abs(rack.servo.position - rack.home).max() < 1e-3
    assert rack.servo.touches == 0


@pytest.mark.parametrize("died_at_s", [0.1, 1.0])
def test_executor_that_starts_anew_keeps_its_grip(died_at_s: float) -> None:
    rack = PrimitiveRack()
    rack.command(gripper(1, opening=0.0, held=0, force=17.0))
    rack.run(died_at_s)
    rack.tasks["primitive"].due = -1
    rack.run(0.02)
    rack.restart("primitive")
    rack.run(1.0)
    assert (rack.status.done, rack.status.held) == (1, 0)
    assert (rack.set_points[-1]["force"], rack.set_points[-1]["opening"]) == (17.0, 0.0)


def test_planner_that_starts_anew_makes_the_plan_that_was_lost() -> None:
    rack = PrimitiveRack()
    rack.command(*two_paths(rack))
    rack.run(0.03)
    rack.restart("primitive.planner")
    assert rack.run_until_done(2)


def test_executor_that_skips_cycles_goes_on_along_the_path() -> None:
    rack = PrimitiveRack()
    rack.command(*two_paths(rack))
    rack.run(0.3)
    rack.tasks["primitive"].due += 6 * 8
    assert rack.run_until_done(2)
    assert np.abs(rack.servo.position - rack.home).max() < 1e-3


def test_silent_servo_is_an_error_until_it_speaks_again() -> None:
    rack = PrimitiveRack(params={"silent": 2.0})
    rack.command(*two_paths(rack))
    rack.run(0.3)
    servo = rack.tasks["servo"]
    servo.due = -1
    rack.run(2.5)
    assert rack.status.error == Error.BELOW
    assert rack.set_points[-1]["due"] == 0
    servo.due = rack.tick
    assert rack.run_until_done(2)
    assert rack.status.error == 0
