"""A servo level whose arm has drives that follow set points."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import pytest

from rack.backplane.watch.alarms import BRAKED_WITHOUT_TORQUE, Alarm
from rack.levels.arm import JointTarget
from rack.levels.level import Finding
from rack.levels.messages import Error
from rack.levels.operator import Answer, Operation
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.servo.control import LoopGains, SetPointLaw
from rack.levels.servo.curves import Motion
from rack.levels.tables import Interface, SceneConfig
from tests.boards.config.mistakes import find_mistake
from tests.levels.arm.test_own_arm import GOAL, START
from tests.levels.arm.test_set_points import SET_POINTS, ServoArm
from tests.levels.arms import CLOCK_NS, pendulum
from tests.levels.lockstep import Operator
from tests.levels.servo.rig import TICK_S, Course, ServoRig

COURSE = Course(START, GOAL, 0.8)
OWN = f"{__name__}:"
PD = "rack.levels.servo.common_modifications:JointPd"
IDEAL = "tests.levels.arm.test_own_arm:IdealArm"
STUCK_AT = 150


class StuckServoArm(ServoArm):
    """An arm whose drives stop following from a tick on, without reporting it."""

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        kept = self._rows[0].copy()
        found = super().follow(target, grip_force)
        if self.tick >= STUCK_AT:
            self._rows[0, 1] = kept[1]
            self._rows[1, 1] = 0.0
        return found


@pytest.fixture(params=SET_POINTS)
def interface(request: pytest.FixtureRequest) -> Interface:
    return cast(Interface, request.param)


def rig(folder: Path, interface: Interface, arm: str = "", **robot: object) -> ServoRig:
    params = {"arm": arm} if arm else {}
    return ServoRig(pendulum(folder, interface=interface, **robot), SceneConfig(), **params)


@pytest.mark.slow
@pytest.mark.parametrize("arm", ["", OWN + "ServoArm"])
def test_the_arm_follows_its_set_points(tmp_path: Path, interface: Interface, arm: str) -> None:
    servo = rig(tmp_path, interface, arm)
    servo.run(500, COURSE.at)
    assert np.abs(servo.errors(COURSE.at)).max() < 8e-3
    assert np.abs(servo.status.position - GOAL).max() < 5e-4
    assert not servo.alarms()
    assert (servo.status.clipped, servo.status.violations) == (0, 0)
    # It says what torque was predicted for the motion: at rest that of gravity.
    holding = servo.servo.terms.bias
    assert servo.status.torque == pytest.approx(holding, abs=0.3)


@pytest.mark.slow
def test_the_end_of_a_bring_up_does_not_move_the_set_points(tmp_path: Path) -> None:
    servo = rig(tmp_path, "position", OWN + "ServoArm", bring_up=0.5)
    slow = Course(START, GOAL, 1.6)
    servo.run(320, slow.at)
    Operator(servo.rack).say("servo", Operation.RELEASE)
    servo.run(600, slow.at)
    assert np.abs(servo.status.position - GOAL).max() < 1e-3
    assert servo.status.answer == Answer.DONE
    assert not servo.alarms()


@pytest.mark.slow
def test_missed_cycles_end_where_the_arm_is(tmp_path: Path, interface: Interface) -> None:
    servo = rig(tmp_path, interface)
    random = np.random.default_rng(4)
    servo.run(5, COURSE.at)
    servo.miss(12)
    servo.run(20, COURSE.at)
    assert servo.alarms() == [Alarm.BRAKES_CLOSED, Alarm.BRAKES_OPENED]
    assert servo.found[0].finding.subject == BRAKED_WITHOUT_TORQUE
    for _ in range(20):
        servo.run(int(random.integers(5, 20)), COURSE.at)
        # Some of these outlast the patience of the drives.
        servo.miss(int(random.integers(1, 7)))
    # So it is after a restart.
    servo.restart()
    servo.run(400, COURSE.at)
    assert set(servo.alarms()) == {Alarm.BRAKES_CLOSED, Alarm.BRAKES_OPENED}
    assert np.abs(servo.status.position - GOAL).max() < 5e-4
    assert servo.status.violations == 0


@pytest.mark.slow
def test_a_weak_motor_is_found_by_its_torque(tmp_path: Path, interface: Interface) -> None:
    servo = rig(tmp_path, interface)
    servo.run(100, COURSE.at)
    since = servo.inject("actuator-off", joint=0)
    servo.run(30, COURSE.at)
    found = next(f for f in servo.found if f.finding.alarm is Alarm.ACTUATOR)
    assert found.finding.subject == 0
    assert found.tick - since < 12
    assert servo.servo.arm.braked
    servo.heal()
    servo.run(900, COURSE.at)
    assert np.abs(servo.status.position - GOAL).max() < 5e-4
    assert servo.status.violations == 0


@pytest.mark.slow
def test_a_drive_that_is_stuck_is_a_motor_fault(tmp_path: Path, interface: Interface) -> None:
    servo = rig(tmp_path, interface, OWN + "StuckServoArm")
    servo.run(STUCK_AT, COURSE.at)
    assert not servo.alarms()
    servo.run(100, COURSE.at)
    found = servo.found[0].finding
    assert (found.alarm, found.subject) == (Alarm.ACTUATOR, 1)
    assert abs(found.value) == pytest.approx(servo.servo.settings.following, rel=0.3)
    assert servo.status.error == Error.NONE
    assert "motor of 'elbow'" in servo.status.reason


def test_set_points_are_for_the_end_of_the_cycle(tmp_path: Path, interface: Interface) -> None:
    cell: Cell = build_cell(pendulum(tmp_path, interface=interface), SceneConfig(), CLOCK_NS)
    law = SetPointLaw(cell, LoopGains(), TICK_S)
    law.set_gains(LoopGains(bandwidth=60.0, damping=1.5))
    now, later = (np.array([[0.1, 0.2], [1.0, -1.0], [4.0, 8.0]]) for _ in range(2))
    later[1] += TICK_S * now[2]
    later[0] += TICK_S * 0.5 * (now[1] + later[1])
    off = np.array([0.01, 0.0])
    torque = np.array([3.0, 4.0])
    target = law.compute_target(Motion(now), now[0] - off, torque)
    correction = 20.0 * off if interface == "velocity" else 0.0
    assert target.position == pytest.approx(later[0], abs=1e-12)
    assert target.velocity == pytest.approx(later[1] + correction, abs=1e-12)
    assert target.torque is torque


@pytest.mark.parametrize(
    ("rack", "change", "mistake"),
    [
        ("rccl", "", 'board.arm.executor = "ArmExecutor": it gives torques'),
        ("penn", "", 'board.arm.executor = "ForceArmExecutor": it gives torques'),
        ("hic", "", 'robot.interface = "position": tendons of a hand need tensions'),
        ("k1607", f"arm='{IDEAL}'", f'board.servo.params.arm = "{IDEAL}": no `follow`'),
        (
            "k1607",
            f"modifications.pd.class='{PD}'",
            'board.servo.params.modifications = "pd": they modify a law of torques',
        ),
    ],
)
def test_settings_that_need_torques_are_refused(rack: str, change: str, mistake: str) -> None:
    changes = [f"board.servo.params.{change}"] if change else []
    assert find_mistake(rack, "robot.interface='position'", *changes).startswith(mistake)
