"""An arm with a separate board, driven by the torques of one board or of six."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from rack.backplane.watch.alarms import Alarm
from rack.levels.level import Demand
from rack.levels.operator import Answer, Operation
from rack.levels.systems.joint_boards import JointServo
from tests.levels.box import mute
from tests.levels.lockstep import Operator
from tests.levels.servo.joint_rig import APART, JOINTS, TOGETHER, JointRig

LAST = f"servo_{JOINTS[-1]}"
WARM_UP = 200
"""Ticks after which the arm swings."""
NEAR_RAD = 1e-3
"""Bound of the tracking error: joints do not know of each other's motion."""


def swinging(servos: Mapping[str, Mapping[str, Any]] = APART, **arm: float | str) -> JointRig:
    rig = JointRig(servos, **arm)
    rig.run(WARM_UP)
    assert np.ptp(rig.positions, axis=0).min() > 0.01
    return rig


def assert_goes_on(rig: JointRig) -> None:
    """Check that the arm swings, follows its targets, and has kept its limits."""
    since = len(rig.positions)
    rig.run(600)
    assert np.ptp(rig.positions[since + 50 :], axis=0).min() > 0.05
    assert np.abs(rig.errors()[since + 50 :]).max() < NEAR_RAD
    assert (rig.status.violations, rig.status.reason) == (0, "")


@pytest.mark.slow
def test_six_boards_move_the_arm_as_one_does() -> None:
    together, apart = JointRig(TOGETHER), JointRig(APART)
    for rig in (together, apart):
        rig.run(900)
    assert np.array_equal(together.positions, apart.positions)
    assert np.abs(apart.errors()).max() < NEAR_RAD
    assert np.ptp(apart.positions, axis=0).min() > 0.1


def test_arm_is_braked_until_every_board_sends_torques_and_then_stays_where_it_is() -> None:
    rig = JointRig(APART)
    rig.rack.tasks["swing"].due = -1
    rig.rack.tasks[LAST].due = 50
    rig.run(50)
    assert all(rig.braked)
    assert rig.status.reason == f"no torque from board '{LAST}' yet"
    rig.run(500)
    assert not any(rig.braked[60:])
    assert np.abs(rig.positions[-1] - rig.arm.cell.home).max() < NEAR_RAD


@pytest.mark.slow
def test_a_silent_or_lost_board_brakes_all_joints_until_it_is_back() -> None:
    rig = swinging()
    rig.rack.disturb("servo_j2.command", mute, ticks=100)
    rig.run(3)
    assert not any(rig.braked[-3:])
    rig.run(1)
    assert rig.braked[-1]
    rig.run(200)
    rig.rack.lose("servo_j3", ticks=300)
    rig.run(1)
    assert rig.braked[-1]
    assert rig.status.reason == "board 'servo_j3' is lost: braked until it is back"
    rig.run(298)
    assert all(rig.braked[-298:])
    rig.run(10)
    assert not rig.braked[-1]
    assert_goes_on(rig)


@pytest.mark.slow
def test_restarted_board_of_the_arm_finds_it_where_it_is() -> None:
    rig = swinging()
    before = rig.positions[-1]
    rig.rack.lose("arm", ticks=50)
    rig.run(54)
    assert np.abs(rig.positions[-1] - before).max() < 0.04  # the way that the brakes need
    assert rig.arm.arm.violations == 0
    assert_goes_on(rig)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "alarm", "parameters"),
    [
        ("sensor-bias", Alarm.SENSOR_MODEL, {"joint": 2, "size": 0.02}),
        ("actuator-off", Alarm.ACTUATOR, {"joint": 1}),
        ("command-limit", Alarm.COMMAND_LIMIT, {"joint": 3, "factor": 5.0}),
    ],
)
def test_a_fault_brakes_the_arm(kind: str, alarm: Alarm, parameters: dict[str, float]) -> None:
    rig = swinging(retry=0.1)
    rig.inject(kind, **parameters)
    rig.run(60)
    assert alarm in rig.alarms()
    assert rig.braked[-1]
    rig.heal()
    rig.run(200)
    assert_goes_on(rig)


@pytest.mark.slow
def test_arm_is_not_released_towards_where_its_sensors_did_not_see_it() -> None:
    rig = JointRig(TOGETHER, following=0.01)
    # At its fastest: blind, it is thought to stop earlier or later than it does.
    rig.run(WARM_UP + 60)
    rig.inject("sensor-dropout")
    rig.run(200)
    rig.heal()
    rig.run(30)
    assert np.abs(np.diff(rig.positions[-30:], axis=0)).max() > 0.01
    assert Alarm.ACTUATOR not in rig.alarms()
    rig.run(100)
    assert_goes_on(rig)


class Nonsense(JointServo):
    """Writes NaN for a while."""

    def process(self, tick: int) -> None:
        super().process(tick)
        if WARM_UP <= tick < WARM_UP + 20:
            self.command.torque[0] = np.nan


def test_torque_of_a_board_that_is_nan_never_reaches_the_arm() -> None:
    rig = JointRig({"servo": {"gripper": True}}, servo=Nonsense)
    rig.run(WARM_UP + 3)
    assert rig.braked[-1]
    assert rig.status.reason.startswith("rejected: torque of 'j1' is not finite")
    rig.run(50)
    assert_goes_on(rig)


@pytest.mark.slow
def test_stop_brings_the_arm_to_rest_by_torques_before_it_is_braked() -> None:
    rig = swinging()
    rig.rack.stop(Demand.STOP, ticks=400)
    rig.run(400)
    ramp = np.flatnonzero(rig.braked[WARM_UP:])[0]
    assert 10 < ramp < 300
    # Rad a tick: it creeps.
    assert np.abs(np.diff(rig.positions[WARM_UP + ramp - 2 :], axis=0)).max() < 5e-5
    assert all(rig.braked[WARM_UP + ramp :])
    rig.run(20)
    assert_goes_on(rig)
    rig.rack.stop(Demand.BRAKE, ticks=50)
    rig.run(1)
    assert rig.braked[-1]


@pytest.mark.slow
def test_operator_moves_the_joint_of_one_board() -> None:
    rig = swinging()
    operator = Operator(rig.rack)
    operator.say("servo_j2", Operation.SETPOINT, joints=[1.2])
    rig.run(1000)
    assert abs(rig.positions[-1][1] - 1.2) < NEAR_RAD
    assert np.abs(np.diff(rig.positions[-50:], axis=0)).max() < 1e-5
    assert rig.rack.read("servo_j2.status").answer == Answer.DONE
    operator.say("servo_j2", Operation.RESUME)
    rig.run(1000)
    assert_goes_on(rig)
