"""An arm is driven while it is enabled: asked by its operator, it goes on from where it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.backplane.message import State
from rack.backplane.watch.alarms import Alarm
from rack.levels.arm import DriveState
from rack.levels.messages import Error
from rack.levels.operator import Answer, Operation
from rack.levels.tables import SceneConfig
from tests.levels.arm.test_own_arm import GOAL, START, IdealArm
from tests.levels.arms import pendulum
from tests.levels.lockstep import Operator
from tests.levels.servo.rig import Course, ServoRig

AWAY = np.array([0.3, -0.2])


class StatefulArm(IdealArm):
    """Its drives take some ticks to be enabled, and start away from home."""

    ticks = 5

    def __init__(self, *given: object, **named: object) -> None:
        super().__init__(*given, **named)  # type: ignore[arg-type]
        self._q += AWAY
        self._ready_at = -1

    def enable(self) -> None:
        self.state, self._ready_at = DriveState.ENABLING, self.tick + self.ticks

    def reset(self) -> None:
        self.fault, self.state = "", DriveState.DISABLED

    def fail(self, why: str) -> None:
        self.brake()
        self.fault, self.state = why, DriveState.FAULT

    def step(self, ticks: int) -> None:
        super().step(ticks)
        if self.state is DriveState.ENABLING and self.tick >= self._ready_at:
            self.state = DriveState.ENABLED


def rig(folder: Path, arm: str = "StatefulArm", **robot: object) -> ServoRig:
    given = {"enable": None, **robot}
    return ServoRig(
        pendulum(folder, **given), SceneConfig(), name="own", arm=f"{__name__}:{arm}", patience=0.1
    )


def test_an_arm_of_ones_own_waits_for_its_operator_and_goes_on_from_where_it_is(
    tmp_path: Path,
) -> None:
    servo = rig(tmp_path)
    operator = Operator(servo.rack)
    servo.run(200)
    status = servo.status
    assert (status.state, status.error, status.braked) == (State.HOLDING, Error.DISABLED, 1)
    assert status.reason == "disabled; to enable: rack command own servo enable"
    assert np.abs(status.position - START - AWAY).max() == 0.0
    operator.say("servo", Operation.ENABLE)
    servo.run(3)
    assert (servo.status.reason, servo.status.answer) == (
        "drives are being enabled",
        Answer.TAKEN,
    )
    servo.run(100)
    assert (servo.status.braked, servo.status.answer, servo.status.error) == (0, Answer.DONE, 0)
    # Held by torques, where it was.
    assert np.abs(servo.status.position - START - AWAY).max() < 1e-3
    assert servo.alarms() == [Alarm.BRAKES_OPENED]


def test_a_fault_of_the_drives_is_the_reason_until_reset_and_enable(tmp_path: Path) -> None:
    servo = rig(tmp_path)
    operator = Operator(servo.rack)
    operator.say("servo", Operation.ENABLE)
    begin = START + AWAY
    course = Course(begin, GOAL, 0.8)
    servo.run(100, course.at)
    assert not servo.status.braked
    arm = servo.servo.arm
    assert isinstance(arm, StatefulArm)
    arm.fail("j2: bus voltage too low")
    servo.run(200, course.at)
    status = servo.status
    assert (status.state, status.error, status.braked) == (State.HOLDING, Error.DRIVES, 1)
    assert status.reason == (
        "drives: j2: bus voltage too low; to clear: rack command own servo reset, then enable"
    )
    operator.say("servo", Operation.ENABLE)
    servo.run(2, course.at)
    assert servo.status.answer == Answer.REFUSED
    assert servo.status.objection == servo.status.reason
    operator.say("servo", Operation.RESET)
    servo.run(2, course.at)
    assert (servo.status.error, servo.status.answer) == (Error.DISABLED, Answer.DONE)
    arm._q += 0.1  # moved by hand
    operator.say("servo", Operation.ENABLE)
    servo.run(900, course.at)
    assert (servo.status.error, servo.status.braked) == (0, 0)
    assert np.abs(servo.status.position - GOAL).max() < 5e-3
    assert Alarm.LATCHED not in servo.alarms()
    assert not {Alarm.SENSOR_MODEL, Alarm.SENSOR_RANGE} & set(servo.alarms())


@pytest.mark.parametrize("kind", ["StatefulArm", "IdealArm"])
def test_a_disabled_arm_is_disabled_after_a_restart_and_an_enabled_one_goes_on(
    tmp_path: Path, kind: str
) -> None:
    servo = rig(tmp_path, kind)
    operator = Operator(servo.rack)
    operator.say("servo", Operation.ENABLE)
    servo.run(50)
    assert not servo.status.braked
    servo.restart()
    servo.run(20)
    assert not servo.status.braked
    operator.say("servo", Operation.DISABLE)
    servo.run(20)
    assert (servo.status.answer, servo.status.error) == (Answer.DONE, Error.DISABLED)
    servo.restart()
    servo.run(50)
    assert (servo.status.braked, servo.status.error) == (1, Error.DISABLED)


def test_guessed_values_keep_an_arm_of_ones_own_disabled_and_a_simulated_one_not(
    tmp_path: Path,
) -> None:
    guessed = ("velocity", "torque")
    for enable in ("at-start", None):
        servo = rig(tmp_path, enable=enable, guessed=guessed)
        Operator(servo.rack).say("servo", Operation.ENABLE)
        servo.run(20)
        why = "confirm, then remove from robot.guessed, before it is enabled: velocity, torque"
        assert (servo.status.reason, servo.status.objection) == (why, why)
        assert servo.servo.arm.state is DriveState.DISABLED
    simulated = ServoRig(pendulum(tmp_path, enable=None, guessed=guessed), SceneConfig())
    simulated.run(20)
    assert not simulated.status.braked
