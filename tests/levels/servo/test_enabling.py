"""An arm is only driven while it is enabled, and starts from where it is."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import pytest

from rack.backplane.message import State
from rack.backplane.watch.alarms import Alarm
from rack.boards.config import load
from rack.levels.arm import DriveState, Sensed, SimulatedArm
from rack.levels.messages import Error
from rack.levels.operator import Answer, Operation
from rack.levels.planning.ik import InverseKinematics
from rack.levels.servo import ServoExecutor
from rack.levels.tables import SceneConfig
from tests.levels.arm.test_own_arm import GOAL, START, IdealArm
from tests.levels.arms import pendulum
from tests.levels.lockstep import Operator
from tests.levels.servo.rig import Course, ServoRig
from tests.levels.whole_rack import WholeRack

AWAY = np.array([0.3, -0.2])


class StatefulArm(IdealArm):
    """An arm whose drives take some ticks to be enabled, and which starts away from home."""

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


class OffArm(IdealArm):
    """An arm whose drives have another zero position."""

    def sense(self) -> Sensed:
        sample = super().sense()
        return sample._replace(position=sample.position - (0.1, -0.2))


def rig(folder: Path, arm: str = "StatefulArm", **robot: object) -> ServoRig:
    given = {"enable": None, **robot}
    arm, params = pendulum(folder, **given), {"arm": f"{__name__}:{arm}", "patience": 0.1}
    return ServoRig(arm, SceneConfig(), name="own", **params)


def test_a_users_arm_waits_for_its_operator_and_moves_from_where_it_is(tmp_path: Path) -> None:
    servo = rig(tmp_path)
    operator = Operator(servo.rack)
    servo.run(200)
    status = servo.status
    assert (status.state, status.error, status.braked) == (State.HOLDING, Error.DISABLED, 1)
    assert status.reason == "disabled; to enable: rack command own servo enable"
    assert np.abs(status.position - START - AWAY).max() == 0.0
    operator.say("servo", Operation.ENABLE)
    servo.run(3)
    assert (servo.status.reason, servo.status.answer) == ("drives are being enabled", Answer.TAKEN)
    servo.run(100)
    assert (servo.status.braked, servo.status.answer, servo.status.error) == (0, Answer.DONE, 0)
    # Held by torques, where it was.
    assert np.abs(servo.status.position - START - AWAY).max() < 1e-3
    assert servo.alarms() == [Alarm.BRAKES_OPENED]


def test_a_drive_fault_is_the_reported_reason_until_reset_and_enable(tmp_path: Path) -> None:
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
    assert status.reason == ("drives: j2: bus voltage too low; to go on: `reset`, then `enable`")
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
def test_a_restarted_board_leaves_the_arm_as_it_was(tmp_path: Path, kind: str) -> None:
    servo = rig(tmp_path, kind)
    operator = Operator(servo.rack)
    operator.say("servo", Operation.ENABLE)
    servo.run(50)
    assert not servo.status.braked
    # Old commands are read again: of them, the last one counts.
    for what in (Operation.DISABLE, Operation.ENABLE):
        operator.say("servo", what)
        servo.run(20)
    servo.restart()
    servo.run(1)
    assert servo.servo.arm.state is DriveState.ENABLED
    servo.run(20)
    assert not servo.status.braked
    operator.say("servo", Operation.DISABLE)
    servo.run(20)
    assert (servo.status.answer, servo.status.error) == (Answer.DONE, Error.DISABLED)
    servo.restart()
    servo.run(50)
    assert (servo.status.braked, servo.status.error) == (1, Error.DISABLED)


@pytest.mark.slow
def test_bring_up_slows_the_operators_set_points_until_released(tmp_path: Path) -> None:
    servo = rig(tmp_path, "IdealArm", enable="at-start", bring_up=0.1)
    operator = Operator(servo.rack)
    servo.run(2)
    assert servo.status.reason == "10% of full speed; to end that: rack command own servo release"
    limits = servo.servo.cell.limits.velocity
    operator.say("servo", Operation.SETPOINT, joints=(0.5, 0.0))
    servo.run(1)
    assert servo.status.reason == "at the setpoint by the operator; `resume` releases it"
    servo.run(2000)
    assert servo.status.slowed
    fastest = np.abs(np.diff(servo.positions, axis=0)).max(axis=0) / 2.5e-3
    assert (0.05 * limits < fastest).any()
    assert (fastest <= 0.1 * limits).all()
    operator.say("servo", Operation.RELEASE)
    servo.run(1)
    assert (servo.status.slowed, servo.status.answer) == (0, Answer.DONE)
    servo.restart()
    servo.run(2)
    assert not servo.status.slowed
    operator.say("servo", Operation.SETPOINT, joints=(0.0, 0.5))
    servo.positions.clear()
    servo.run(400)
    fastest = np.abs(np.diff(servo.positions, axis=0)).max(axis=0) / 2.5e-3
    assert (0.1 * limits < fastest).any()


@pytest.mark.parametrize("latency_ticks", [0, 2])
def test_offsets_convert_positions_of_drives(tmp_path: Path, latency_ticks: int) -> None:
    calibration = {"offset": (0.1, -0.2)}
    own = rig(tmp_path, "OffArm", enable="at-start", calibration=calibration)
    robot = pendulum(tmp_path, calibration=calibration, latency_ticks=latency_ticks)
    simulated = ServoRig(robot, SceneConfig())
    course = Course(START, GOAL, 0.8)
    for servo in (own, simulated):
        servo.run(500, course.at)
        assert np.abs(servo.status.position - GOAL).max() < 5e-3
        assert not servo.alarms(Alarm.BRAKES_OPENED)
    assert np.abs(own.servo.arm._q - GOAL).max() < 5e-3  # type: ignore[attr-defined]
    assert np.abs(simulated.servo.arm._state[0] - GOAL).max() < 5e-3  # type: ignore[attr-defined]
    scene = own.rack.read("servo.scene")
    tool = InverseKinematics(own.servo.cell, 0).compute_tool_pose(own.servo.arm._q)  # type: ignore[attr-defined]
    assert np.abs(scene.tool_position - tool.position).max() < 1e-3


def test_guessed_values_keep_a_users_arm_disabled_but_not_a_simulated_one(tmp_path: Path) -> None:
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


@pytest.mark.slow
def test_the_levels_above_wait_and_plan_from_where_the_arm_is_enabled() -> None:
    config = load("nasrem-three-poses")
    assert config.robot is not None
    away = {"enable": "by-command", "start": (0.3, 1.2, -2.8, 0.1, -1.2, 0.2)}
    given = config.robot.model_copy(update=away), config.scene
    rack = WholeRack("nasrem-three-poses", given, params={"task": {"stalled_s": 3.0}})
    arm = cast(ServoExecutor, rack.tasks["servo"].level).arm
    assert isinstance(arm, SimulatedArm)
    rack.run(9.0)  # longer than a task may stall
    assert rack.task.state == State.HOLDING
    assert rack.task.reason.startswith("waiting for servo: disabled; to enable:")
    # By hand, once the first path is planned.
    arm._data.qpos[arm.cell.qpos[0]] -= 0.5
    arm._read_joint_state()
    arm._rest[:] = arm._state[0]
    rack.run(0.5)
    Operator(rack).say("servo", Operation.ENABLE)
    assert rack.run_to_end(30.0).state == State.DONE
    status = rack.read("servo.status")
    assert (status.touches, status.violations) == (0, 0)
