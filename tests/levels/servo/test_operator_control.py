"""The servo level under an operator: it holds, moves to set points and returns."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.algebra import Array
from rack.levels.operator import Answer, Operation
from tests.levels.arms import cell, config
from tests.levels.lockstep import Operator
from tests.levels.servo.rig import TICK_S, Course, ServoRig

HOME = cell("puma560").home
LIMITS = cell("puma560").limits
AWAY = HOME + np.array([0.3, -0.2, 0.2, 0.1, -0.2, 0.3])
COURSE = Course(HOME, HOME + 0.5 * np.array([1.0, -0.4, 0.4, 0.5, 0.5, 1.0]), 2.0)
QUICK = COURSE._replace(duration_s=0.6)
SECOND = round(1.0 / TICK_S)
PD = {"class": "rack.levels.servo.common_modifications:JointPd"}


@pytest.fixture
def rig() -> ServoRig:
    return ServoRig(*config("puma560"))


@pytest.mark.slow
def test_a_hold_ramps_to_rest_and_ignores_the_level_above_until_resume(rig: ServoRig) -> None:
    rig.run(SECOND, COURSE.at)
    assert np.abs(rig.status.target_velocity).max() > 0.1
    operator = Operator(rig.rack)
    serial = operator.say("servo", Operation.HOLD)
    rig.run(1, COURSE.at)
    status = rig.status
    assert (status.order, status.operator, status.answer) == (serial, serial, Answer.TAKEN)
    rig.run(2 * SECOND, COURSE.at)
    held = rig.status.position.copy()
    rig.run(SECOND, COURSE.at)
    assert (rig.status.answer, rig.status.standing) == (Answer.DONE, Operation.HOLD)
    assert (rig.status.holding, rig.status.stopped, rig.status.braked) == (1, 1, 0)
    assert np.abs(rig.status.position - held).max() < 1e-4
    assert_within_limits(np.array(rig.targets[SECOND:]))
    serial = operator.say("servo", Operation.RESUME)
    rig.run(3 * SECOND, COURSE.at)
    assert (rig.status.order, rig.status.answer) == (serial, Answer.DONE)
    assert (rig.status.holding, rig.status.stopped, rig.status.standing) == (0, 0, Operation.NONE)
    assert np.abs(rig.status.position - COURSE.goal).max() < 1e-3


@pytest.mark.slow
def test_a_set_point_given_during_motion_is_preceded_by_rest(rig: ServoRig) -> None:
    rig.run(SECOND, COURSE.at)
    Operator(rig.rack).say("servo", Operation.SETPOINT, AWAY)
    rig.run(1, COURSE.at)
    assert rig.status.answer == Answer.TAKEN
    rig.run(3 * SECOND, COURSE.at)
    assert rig.status.answer == Answer.DONE
    assert np.array_equal(rig.status.target, AWAY)
    assert np.abs(rig.status.position - AWAY).max() < 1e-3
    assert_within_limits(np.array(rig.targets[SECOND:]))


@pytest.mark.slow
def test_from_its_set_points_the_arm_returns_the_same_way(rig: ServoRig) -> None:
    operator = Operator(rig.rack)
    rig.run(SECOND // 2)
    # A hold on the way stops there.
    operator.say("servo", Operation.SETPOINT, AWAY)
    rig.run(SECOND // 4)
    operator.say("servo", Operation.HOLD)
    rig.run(SECOND)
    assert rig.status.answer == Answer.DONE
    assert 0.01 < np.abs(rig.status.target - HOME).max() < np.abs(AWAY - HOME).max() - 0.01
    assert_within_limits(np.array(rig.targets))
    second = AWAY + 0.1
    for goal in (AWAY, second):
        operator.say("servo", Operation.SETPOINT, goal)
        rig.run(2 * SECOND)
    operator.say("servo", Operation.RESUME)
    rig.run(1)
    status = rig.status
    assert (status.answer, status.standing) == (Answer.TAKEN, Operation.NONE)
    assert status.stopped == 1
    began = len(rig.targets)
    rig.run(3 * SECOND)
    assert (rig.status.answer, rig.status.stopped) == (Answer.DONE, 0)
    assert np.abs(rig.status.target - HOME).max() < 1e-6
    assert min(np.abs(target - AWAY).max() for target in rig.targets[began:]) < 1e-9


def test_a_set_point_out_of_range_is_refused(rig: ServoRig) -> None:
    operator = Operator(rig.rack)
    operator.say("servo", Operation.HOLD)
    rig.run(SECOND // 2, COURSE.at)
    beyond = AWAY.copy()
    beyond[1] = LIMITS.position[1, 1] + 0.001
    operator.say("servo", Operation.SETPOINT, beyond)
    rig.run(SECOND // 2, COURSE.at)
    assert (rig.status.answer, rig.status.standing) == (Answer.REFUSED, Operation.HOLD)
    assert rig.status.objection.startswith(f"joint '{config('puma560')[0].joints[1]}' at ")
    assert np.abs(rig.status.position - HOME).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("key", "value"), [("bandwidth", 30.0), ("damping", 0.7)])
def test_a_gain_set_live_acts_like_one_set_in_the_config(key: str, value: float) -> None:
    launched = ServoRig(*config("puma560"), **{key: value})
    tuned = ServoRig(*config("puma560"))
    Operator(tuned.rack).set("servo", f"{key}={value}")
    assert (tuned.torques(300, QUICK.at) == launched.torques(300, QUICK.at)).all()
    assert tuned.status.answer == Answer.DONE


@pytest.mark.slow
def test_gains_act_from_the_cycle_after_their_tick_and_survive_a_restart() -> None:
    tuned, plain = (ServoRig(*config("puma560")) for _ in range(2))
    before = tuned.torques(100, QUICK.at), plain.torques(100, QUICK.at)
    assert (before[0] == before[1]).all()
    Operator(tuned.rack).set("servo", "bandwidth=300")
    after = tuned.torques(100, QUICK.at), plain.torques(100, QUICK.at)
    assert (after[0] != after[1]).any(axis=1).all()
    tuned.restart()
    tuned.torques(1, QUICK.at)
    assert tuned.servo.settings.bandwidth == 300.0


@pytest.mark.slow
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
def test_an_invalid_gain_is_refused_and_the_law_continues(setting: str, why: str) -> None:
    tuned, plain = (ServoRig(*config("puma560")) for _ in range(2))
    Operator(tuned.rack).set("servo", setting)
    assert (tuned.torques(50, QUICK.at) == plain.torques(50, QUICK.at)).all()
    assert tuned.status.answer == Answer.REFUSED
    assert tuned.status.objection.startswith(why)


def rig_of(**modifications: dict[str, Any]) -> ServoRig:
    return ServoRig(*config("puma560"), modifications=modifications)


@pytest.mark.slow
def test_a_law_is_replaced_under_motion_without_a_step_and_the_arm_follows_its_course() -> None:
    rig = rig_of(pd=PD)
    operator = Operator(rig.rack)
    before = rig.torques(300, COURSE.at)
    serial = operator.modify("servo", "pd", True)
    replaced = rig.torques(200, COURSE.at)
    status = rig.status
    assert (status.order, status.answer, status.operator) == (serial, Answer.DONE, serial)
    assert (rig.status.state, rig.status.reason) == (State.EXECUTING, "modified by pd")
    assert replaced[0] == pytest.approx(before[-1], abs=1e-12)
    assert not np.allclose(replaced[-1], before[-1], atol=0.1)
    operator.modify("servo", "pd", False)
    again = rig.torques(500, COURSE.at)
    assert again[0] == pytest.approx(replaced[-1], abs=1e-12)
    assert rig.status.position == pytest.approx(COURSE.goal, abs=1e-3)
    assert (rig.status.reason, rig.found) == ("", [])


def test_a_restarted_board_switches_its_modifications_on_again() -> None:
    rig = rig_of(pd=PD)
    rig.torques(100, COURSE.at)
    Operator(rig.rack).modify("servo", "pd", True)
    rig.torques(100, COURSE.at)
    rig.restart()
    rig.torques(3, COURSE.at)
    assert rig.status.reason == "modified by pd"


def test_a_hold_stays_in_force_over_a_modification_and_an_unknown_one_is_refused() -> None:
    rig = rig_of(pd=PD)
    operator = Operator(rig.rack)
    rig.torques(100, COURSE.at)
    operator.say("servo", Operation.HOLD)
    rig.torques(200, COURSE.at)
    operator.modify("servo", "pd", True)
    rig.torques(2, COURSE.at)
    assert (rig.status.standing, rig.status.answer) == (Operation.HOLD, Answer.DONE)
    assert rig.status.reason == "held by the operator; `resume` releases it"
    operator.modify("servo", "notch", True)
    rig.torques(2, COURSE.at)
    assert (rig.status.standing, rig.status.answer) == (Operation.HOLD, Answer.REFUSED)
    assert rig.status.objection == "no modification 'notch'; permitted: pd"


def assert_within_limits(targets: Array) -> None:
    """Check a reference, (ticks, joints), rad, against the limits of planned motion."""
    velocity = np.diff(targets, axis=0) / TICK_S
    acceleration = np.diff(velocity, axis=0) / TICK_S
    assert (np.abs(velocity) <= LIMITS.velocity * 1.001).all()
    assert (np.abs(acceleration[1:]) <= LIMITS.acceleration * 1.05).all()
