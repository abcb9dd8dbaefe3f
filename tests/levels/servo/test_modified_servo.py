"""The servo level with control modifications: those of its arm, its operator and its faults."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.operator import Answer, Operation
from tests.levels.arms import cell, config
from tests.levels.lockstep import Operator
from tests.levels.servo.rig import Course, ServoRig

HOME = cell("puma560").home
COURSE = Course(HOME, HOME + 0.5 * np.array([1.0, -0.4, 0.4, 0.5, 0.5, 1.0]), 2.0)
PD = {"class": "rack.levels.servo.common_modifications:JointPd"}


def rig_of(**modifications: dict[str, Any]) -> ServoRig:
    return ServoRig(*config("puma560"), modifications=modifications)


@pytest.mark.slow
def test_a_law_is_replaced_under_motion_without_a_step_and_the_arm_follows_its_course() -> None:
    rig = rig_of(pd=PD)
    operator = Operator(rig.rack)
    before = rig.torques(300, COURSE.at)
    serial = operator.modify("servo", "pd", True)
    replaced = rig.torques(200, COURSE.at)
    assert (rig.status.order, rig.status.answer, rig.status.operator) == (
        serial,
        Answer.DONE,
        serial,
    )
    assert (rig.status.state, rig.status.reason) == (State.EXECUTING, "modified by pd")
    assert replaced[0] == pytest.approx(before[-1], abs=1e-12)
    assert not np.allclose(replaced[-1], before[-1], atol=0.1)
    operator.modify("servo", "pd", False)
    again = rig.torques(500, COURSE.at)
    assert again[0] == pytest.approx(replaced[-1], abs=1e-12)
    assert rig.status.position == pytest.approx(COURSE.goal, abs=1e-3)
    assert (rig.status.reason, rig.found) == ("", [])


def test_a_restarted_board_puts_its_modifications_in_again() -> None:
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
