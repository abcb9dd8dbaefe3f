"""The servo level's gains, set by its operator while it runs."""

from __future__ import annotations

import numpy as np
import pytest

from rack.levels.operator import Answer
from tests.levels.arms import cell, config
from tests.levels.lockstep import Operator
from tests.levels.servo.rig import Course, ServoRig

HOME = cell("puma560").home
COURSE = Course(HOME, HOME + 0.5 * np.array([1.0, -0.4, 0.4, 0.5, 0.5, 1.0]), 0.6)
pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("key", "value"), [("bandwidth", 30.0), ("damping", 0.7)])
def test_a_gain_set_live_is_that_of_a_level_launched_with_it(key: str, value: float) -> None:
    launched = ServoRig(*config("puma560"), **{key: value})
    tuned = ServoRig(*config("puma560"))
    Operator(tuned.rack).set("servo", f"{key}={value}")
    assert (tuned.torques(300, COURSE.at) == launched.torques(300, COURSE.at)).all()
    assert tuned.status.answer == Answer.DONE


def test_gains_act_from_the_cycle_after_their_tick_and_survive_a_restart() -> None:
    tuned, plain = (ServoRig(*config("puma560")) for _ in range(2))
    before = tuned.torques(100, COURSE.at), plain.torques(100, COURSE.at)
    assert (before[0] == before[1]).all()
    Operator(tuned.rack).set("servo", "bandwidth=300")
    after = tuned.torques(100, COURSE.at), plain.torques(100, COURSE.at)
    assert (after[0] != after[1]).any(axis=1).all()
    tuned.restart()
    tuned.torques(1, COURSE.at)
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
    assert (tuned.torques(50, COURSE.at) == plain.torques(50, COURSE.at)).all()
    assert tuned.status.answer == Answer.REFUSED
    assert tuned.status.objection.startswith(why)
