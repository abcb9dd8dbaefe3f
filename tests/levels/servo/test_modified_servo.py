"""The servo level with control modifications: those of its arm, its operator and its faults."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rack.backplane.message import State
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Demand
from rack.levels.algebra import Array
from rack.levels.operator import Answer, Operation
from rack.levels.servo.modification import Hook, LawSample, Modification
from tests.levels.arms import cell, config
from tests.levels.lockstep import Operator
from tests.levels.servo.rig import Course, ServoRig

HOME = cell("puma560").home
COURSE = Course(HOME, HOME + 0.5 * np.array([1.0, -0.4, 0.4, 0.5, 0.5, 1.0]), 2.0)
PD = {"class": "rack.levels.servo.common_modifications:JointPd"}
BREAKS = {"class": f"{__name__}:Breaks"}


class Breaks(Modification):
    hook = Hook.AFTER

    def modify(self, sample: LawSample) -> None:
        sample.torque[0] = np.inf


def rig_of(**modifications: dict[str, Any]) -> ServoRig:
    return ServoRig(*config("puma560"), modifications=modifications)


def torques(rig: ServoRig, ticks: int) -> Array:
    """Run `ticks` ticks; return the torque of each, (ticks, joints), N m."""
    found = []
    for _ in range(ticks):
        rig.run(1, COURSE.at)
        found.append(rig.status.torque.copy())
    return np.array(found)


@pytest.mark.slow
def test_a_law_is_replaced_under_motion_without_a_step_and_the_arm_follows_its_course() -> None:
    rig = rig_of(pd=PD)
    operator = Operator(rig.rack)
    before = torques(rig, 300)
    serial = operator.modify("servo", "pd", True)
    replaced = torques(rig, 200)
    assert (rig.status.order, rig.status.answer, rig.status.operator) == (
        serial,
        Answer.DONE,
        serial,
    )
    assert (rig.status.state, rig.status.reason) == (State.EXECUTING, "modified by pd")
    assert replaced[0] == pytest.approx(before[-1], abs=1e-12)
    assert not np.allclose(replaced[-1], before[-1], atol=0.1)
    operator.modify("servo", "pd", False)
    again = torques(rig, 500)
    assert again[0] == pytest.approx(replaced[-1], abs=1e-12)
    assert rig.status.position == pytest.approx(COURSE.goal, abs=1e-3)
    assert (rig.status.reason, rig.found) == ("", [])


def test_modifications_that_are_not_put_in_change_no_torque() -> None:
    assert (torques(rig_of(pd=PD), 200) == torques(rig_of(), 200)).all()


@pytest.mark.slow
def test_one_that_fails_leaves_the_law_to_itself() -> None:
    rig = rig_of(breaks=BREAKS)
    torques(rig, 200)
    Operator(rig.rack).modify("servo", "breaks", True)
    rest = torques(rig, 200)
    assert rig.alarms() == [Alarm.MODIFICATION]
    assert rig.status.reason == "modification 'breaks' taken out: its result is not finite"
    assert rest == pytest.approx(torques(rig_of(), 400)[200:], abs=0.05)


def test_a_restarted_board_puts_its_modifications_in_again() -> None:
    rig = rig_of(pd=PD)
    torques(rig, 100)
    Operator(rig.rack).modify("servo", "pd", True)
    torques(rig, 100)
    rig.restart()
    torques(rig, 3)
    assert rig.status.reason == "modified by pd"


def test_a_switch_while_the_arm_is_braked_acts_at_once_when_it_is_released() -> None:
    rig, operator = rig_of(pd=PD), None
    torques(rig, 100)
    rig.rack.stop(Demand.BRAKE, 40)
    torques(rig, 20)
    operator = Operator(rig.rack)
    operator.modify("servo", "pd", True)
    torques(rig, 40)
    assert (rig.status.braked, rig.status.reason) == (0, "modified by pd")


def test_a_hold_stays_in_force_over_a_modification_and_an_unknown_one_is_refused() -> None:
    rig = rig_of(pd=PD)
    operator = Operator(rig.rack)
    torques(rig, 100)
    operator.say("servo", Operation.HOLD)
    torques(rig, 200)
    operator.modify("servo", "pd", True)
    torques(rig, 2)
    assert (rig.status.standing, rig.status.answer) == (Operation.HOLD, Answer.DONE)
    assert rig.status.reason == "held by the operator; `resume` releases it"
    operator.modify("servo", "notch", True)
    torques(rig, 2)
    assert (rig.status.standing, rig.status.answer) == (Operation.HOLD, Answer.REFUSED)
    assert rig.status.objection == "no modification 'notch'; permitted: pd"
