"""The servo level when motors do not give what they are told: found in bounded cycles, within every limit."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from rack.backplane.watch.alarms import Alarm
from tests.levels.arms import config
from tests.levels.servo_rig import TICK_S, Course, ServoRig

Array = NDArray[np.float64]

APPROACH_S = 1.5


class Dash:
    """A motion that brings one joint of an arm to its highest planned speed, from second 1.5 on."""

    def __init__(self, rig: ServoRig, name: str, joint: int, side: float) -> None:
        robot, bounds = config(name)[0], rig.servo.arm._cell.bounds  # type: ignore[attr-defined]
        self._home, self._joint, self._side = np.array(robot.home), joint, side
        self.speed, self._hardest = 0.95 * bounds.velocity[joint], 0.9 * robot.acceleration[joint]
        self.way = self.speed**2 / self._hardest + 0.3
        low, high = np.clip(bounds.position[joint], -2.6, 2.6)
        self._start = self._home.copy()
        middle = np.clip(self._home[joint], low + 0.05 + self.way / 2, high - 0.05 - self.way / 2)
        self._start[joint] = middle - side * self.way / 2

    @property
    def fastest_at(self) -> int:
        """Tick at which the joint has come to that speed."""
        return round((APPROACH_S + self.speed / self._hardest) / TICK_S) + 4

    def at(self, time_s: float) -> tuple[Array, Array]:
        """Return position and velocity."""
        u = min(max(time_s / APPROACH_S, 0.0), 1.0)
        way = self._start - self._home
        position = self._home + way * u**3 * (10 - 15 * u + 6 * u * u)
        velocity = way * 30 * u * u * (1 - u) ** 2 / APPROACH_S
        done, speed = self._along(max(time_s - APPROACH_S, 0.0))
        position[self._joint] += self._side * done
        velocity[self._joint] += self._side * speed
        return position, velocity

    def _along(self, time_s: float) -> tuple[float, float]:
        rising = self.speed / self._hardest
        cruising = 0.3 / self.speed
        left = 2 * rising + cruising - time_s
        if time_s < rising:
            return 0.5 * self._hardest * time_s**2, self._hardest * time_s
        if left > rising:
            return 0.5 * self.speed * rising + self.speed * (time_s - rising), self.speed
        left = max(left, 0.0)
        return self.way - 0.5 * self._hardest * left**2, self._hardest * left


def dashing(name: str, joint: int, side: float, **params: float | str) -> tuple[ServoRig, Dash]:
    rig = ServoRig(*config(name), **params)
    # What hits something is stopped by that.
    rig.servo.arm._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)  # type: ignore[attr-defined]
    dash = Dash(rig, name, joint, side)
    rig.run(dash.fastest_at, dash.at)
    assert rig.status.velocity[joint] * side == pytest.approx(dash.speed, rel=0.01)
    return rig, dash


def found(rig: ServoRig) -> list[int]:
    """Return the ticks in which a motor was found at fault."""
    return [tick for tick, finding in rig.found if finding.alarm is Alarm.ACTUATOR]


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize(
    ("name", "joint"), [("puma560", joint) for joint in range(6)] + [("k1607", joint) for joint in (1, 3, 5)]
)
def test_a_motor_off_at_top_speed_is_found_in_five_cycles_and_breaks_no_limit(
    name: str, joint: int, side: float
) -> None:
    rig, dash = dashing(name, joint, side)
    rig.inject("actuator-off", joint=-1)
    rig.run(150, dash.at)
    assert found(rig)[0] - rig.acted[0] <= 5
    assert (rig.status.stopped, rig.status.braked) == (1, 1)
    assert (rig.status.violations, rig.servo.arm.first_violation) == (0, "")
    assert rig.status.reason.startswith("motor of '")


@pytest.mark.parametrize(
    ("kind", "parameters"), [("actuator-off", {"joint": 1}), ("actuator-saturated", {"joint": 1, "part": 0.05})]
)
def test_a_shoulder_that_loses_its_torque_at_rest_hardly_falls(kind: str, parameters: dict[str, float]) -> None:
    rig = ServoRig(*config("puma560"))
    rig.run(200)
    home = rig.status.position.copy()
    rig.inject(kind, **parameters)
    rig.run(150)
    assert found(rig)[0] - rig.acted[0] <= 5
    assert np.abs(rig.servo.arm.sense().position - home).max() < 0.01


def test_a_motor_at_fault_is_tried_again_and_the_set_points_are_followed_once_it_is_sound() -> None:
    rig, dash = dashing("puma560", 1, 1.0, retry=0.1)
    rig.inject("actuator-off", joint=1)
    rig.run(400, dash.at)
    assert len(found(rig)) == 1  # once, however often it is tried
    assert rig.alarms().count(Alarm.BRAKES_OPENED) >= 3
    assert rig.status.stopped == 1
    rig.heal()
    rig.run(100, dash.at)
    assert (rig.status.stopped, rig.status.braked, rig.status.reason) == (0, 0, "")
    goal = dash.at(60.0)
    rig.run(1200, lambda _: goal)
    assert rig.status.position == pytest.approx(goal[0], abs=1e-3)
    assert (rig.status.violations, len(found(rig))) == (0, 1)


@pytest.mark.parametrize(("reaction", "braked"), [("hold", 0), ("stop", 1)])
def test_an_arm_whose_motor_can_carry_the_ramp_may_do_without_the_brakes(reaction: str, braked: int) -> None:
    rig, dash = dashing("puma560", 0, 1.0, on_actuator_fault=reaction)
    rig.inject("actuator-saturated", joint=0, part=0.1)
    rig.run(195, dash.at)
    assert len(found(rig)) == 1
    assert (rig.status.stopped, rig.status.braked) == (1, braked)
    assert np.abs(rig.status.velocity).max() < 0.01
    assert rig.status.violations == 0


def test_an_arm_that_falls_while_it_is_to_ramp_to_rest_is_braked() -> None:
    rig, dash = dashing("k1607", 0, 1.0, on_actuator_fault="stop")
    rig.inject("actuator-saturated", joint=3, part=0.05)
    rig.run(6, dash.at)
    assert (rig.status.stopped, rig.status.braked) == (1, 0)
    rig.run(150, dash.at)
    assert (rig.status.violations, rig.status.stopped, rig.status.braked) == (0, 1, 1)


def test_a_motor_that_is_asked_for_nothing_is_not_missed() -> None:
    rig = ServoRig(*config("puma560"))
    rig.run(200)
    rig.inject("actuator-off", joint=0)
    rig.run(200)
    assert (rig.acted, rig.found) == ([], [])


@pytest.mark.parametrize("kind", ["command-nan", "command-limit"])
@pytest.mark.parametrize("cycles", [1, 120])
def test_a_corrupted_torque_is_found_in_its_cycle_and_the_arm_braked_until_torques_are_sound(
    kind: str, cycles: int
) -> None:
    rig, dash = dashing("puma560", 0, 1.0)
    parameters = {"factor": 5.0} if kind == "command-limit" else {}
    begun = rig.inject(kind, joint=0, **parameters)
    rig.run(cycles, dash.at)
    alarm = Alarm.COMMAND_INVALID if kind == "command-nan" else Alarm.COMMAND_LIMIT
    assert [(f.tick, f.finding.alarm) for f in rig.found if f.finding.alarm is alarm] == [(begun, alarm)]
    assert (rig.status.stopped, rig.status.braked) == (1, 1)
    assert not rig.status.torque.any()
    rig.heal()
    rig.run(1, dash.at)
    assert (rig.status.stopped, rig.status.braked) == (0, 0)
    goal = dash.at(60.0)
    rig.run(1600, lambda _: goal)
    assert rig.status.position == pytest.approx(goal[0], abs=1e-3)
    assert rig.status.violations == 0


def test_a_motor_off_is_found_where_dry_friction_turns_round_and_hides_what_it_gives() -> None:
    rig = ServoRig(*config("puma560"))
    home = np.array(config("puma560")[0].home)
    # The first joint comes to rest while the others go on.
    first, others = Course(home, home + 0.4, 1.0), Course(home, home + 0.4, 2.0)
    turning = np.array([True, *[False] * 5])

    def motion(time_s: float) -> tuple[Array, Array]:
        (q1, v1), (q, v) = first.at(time_s), others.at(time_s)
        return np.where(turning, q1, q), np.where(turning, v1, v)

    rig.run(380, motion)
    begun = rig.inject("actuator-off", joint=0)
    rig.run(10, motion)
    assert [tick - begun for tick in found(rig)] == [4]
