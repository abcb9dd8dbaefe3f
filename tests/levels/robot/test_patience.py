"""Motors keep their last torque for a time in which the arm does little, by its model; or for the
time that is set."""

from __future__ import annotations

import pytest

from rack.levels.robot.cell import build_cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.limits import (
    MAX_PATIENCE_S,
    MIN_PATIENCE_CYCLES,
    PATIENCE_FRACTION,
    MotorPatience,
    compute_patience,
)
from rack.levels.tables import RobotConfig
from tests.levels.arms import CLOCK_NS, cell, config

ROBOT, SCENE = config("puma560")


@pytest.mark.parametrize("arm", ["puma560", "k1607"])
def test_motors_add_at_most_a_fraction_of_the_energy_that_the_brakes_absorb(
    arm: str,
) -> None:
    made = cell(arm)
    speed, patience = made.bounds.velocity, made.patience
    kinetic = 0.5 * speed @ Dynamics(made).terms(made.home, 0.0 * speed).inertia @ speed
    # The fingers of `Dynamics` are open, those of the model at its reference.
    assert patience.seconds * (speed @ made.bounds.torque) == pytest.approx(
        PATIENCE_FRACTION * kinetic, rel=0.01
    )
    assert (
        patience.seconds * speed <= PATIENCE_FRACTION * 0.5 * speed**2 / config(arm)[0].acceleration
    ).all()


def test_an_arm_with_weak_motors_is_bounded_by_the_angle_and_by_the_longest_time() -> None:
    bounds = cell("puma560").bounds
    hard = ROBOT.model_copy(update={"acceleration": (200.0,) * 6})
    assert compute_patience(hard, bounds, 1e6).seconds == pytest.approx(
        PATIENCE_FRACTION * 0.5 * 1.51 / 200.0
    )
    assert compute_patience(ROBOT, bounds, 1e6) == MotorPatience(
        MAX_PATIENCE_S, MIN_PATIENCE_CYCLES
    )
    # The PUMA: 5 ms at 400 Hz and at 1 kHz.
    patience = cell("puma560").patience
    rates = ((1, 0.0025), (1, 0.001), (5, 0.001))
    assert [patience.ticks(every, tick_s) for every, tick_s in rates] == [2, 5, 10]


@pytest.mark.parametrize(
    ("asked_ms", "ticks"), [(0.9, 1), (2.5, 1), (4.9, 1), (5.0, 2), (7.5, 3), (100.0, 40)]
)
def test_a_patience_that_is_set_is_in_whole_cycles_and_at_least_one(
    asked_ms: float, ticks: int
) -> None:
    given = RobotConfig(**(dict(ROBOT) | {"patience_ms": asked_ms}))
    assert build_cell(given, SCENE, CLOCK_NS).patience.ticks(1, 0.0025) == ticks
