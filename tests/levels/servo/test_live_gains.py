"""The servo level's gains, set by its operator while it runs."""

from __future__ import annotations

import numpy as np
import pytest

from rack.levels.algebra import Array
from rack.levels.operator import Answer
from tests.levels.arms import cell, config
from tests.levels.lockstep import Operator
from tests.levels.servo.rig import Course, ServoRig

HOME = cell("puma560").home
COURSE = Course(HOME, HOME + 0.5 * np.array([1.0, -0.4, 0.4, 0.5, 0.5, 1.0]), 0.6)
pytestmark = pytest.mark.slow


def torques(rig: ServoRig, ticks: int) -> Array:
    """Run `ticks` ticks; return the torque of each, (ticks, joints), N m."""
    found = []
    for _ in range(ticks):
        rig.run(1, COURSE.at)
        found.append(rig.status.torque.copy())
    return np.array(found)


@pytest.mark.parametrize(("key", "value"), [("bandwidth", 30.0), ("damping", 0.7)])
def test_a_gain_set_live_is_that_of_a_level_launched_with_it(key: str, value: float) -> None:
    launched = ServoRig(*config("puma560"), **{key: value})
    tuned = ServoRig(*config("puma560"))
    Operator(tuned.rack).set("servo", f"{key}={value}")
    assert (torques(tuned, 300) == torques(launched, 300)).all()
    assert tuned.status.answer == Answer.DONE


def test_gains_act_from_the_cycle_after_their_tick_and_survive_a_restart() -> None:
    tuned, plain = (ServoRig(*config("puma560")) for _ in range(2))
    before = torques(tuned, 100), torques(plain, 100)
    assert (before[0] == before[1]).all()
    Operator(tuned.rack).set("servo", "bandwidth=300")
    after = torques(tuned, 100), torques(plain, 100)
    assert (after[0] != after[1]).any(axis=1).all()
    tuned.restart()
    torques(tuned, 1)
    assert tuned.servo.given.bandwidth == 300.0


@pytest.mark.parametrize(
    ("setting", "why"),
    {
        "bandwidth=-1": "params.bandwidth = -1: input should be greater than 0",
        "bandwidth=nan": "params.bandwidth = nan: ",
        "patience=1.0": "params.patience is not live; live: bandwidth, damping",
        "stiffness=1": "params.stiffness is not live; live: bandwidth, damping",
        "bandwidth": "must be key=value",
    }.items(),
)
def test_a_gain_that_cannot_be_is_refused_and_the_law_goes_on(setting: str, why: str) -> None:
    tuned, plain = (ServoRig(*config("puma560")) for _ in range(2))
    Operator(tuned.rack).set("servo", setting)
    assert (torques(tuned, 50) == torques(plain, 50)).all()
    assert tuned.status.answer == Answer.REFUSED
    assert tuned.status.objection.startswith(why)
