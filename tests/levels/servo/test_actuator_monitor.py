"""The servo level when motors or torques fail: detection in bounded time within the limits."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array
from rack.levels.level import Finding
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.limits import MAX_CONTACT_FRACTION, MAX_RESTING_CONTACT_FRACTION
from rack.levels.servo.actuator_monitor import SURE_CYCLES, ActuatorMonitor
from tests.levels.arms import cell, config
from tests.levels.servo.rig import TICK_S, Course, ServoRig

APPROACH_S = 1.5


class Dash:
    """A motion that brings one joint of an arm to its highest planned speed, from second 1.5 on."""

    def __init__(self, rig: ServoRig, name: str, joint: int, side: float) -> None:
        robot, bounds = config(name)[0], rig.servo.arm.cell.bounds
        home, self._joint, self._side = np.array(robot.home), joint, side
        self.speed, self._hardest = 0.95 * bounds.velocity[joint], 0.9 * robot.acceleration[joint]
        self.way = self.speed**2 / self._hardest + 0.3
        low, high = np.clip(bounds.position[joint], -2.6, 2.6)
        start = home.copy()
        middle = np.clip(home[joint], low + 0.05 + self.way / 2, high - 0.05 - self.way / 2)
        start[joint] = middle - side * self.way / 2
        self._approach = Course(home, start, APPROACH_S)
        # Tick at which the joint has reached that speed.
        self.fastest_at = round((APPROACH_S + self.speed / self._hardest) / TICK_S) + 4

    def at(self, time_s: float) -> tuple[Array, Array]:
        position, velocity = self._approach.at(time_s)
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
    # A contact would stop the arm.
    rig.servo.arm._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)  # type: ignore[attr-defined]
    dash = Dash(rig, name, joint, side)
    rig.run(dash.fastest_at, dash.at)
    assert rig.status.velocity[joint] * side == pytest.approx(dash.speed, rel=0.01)
    return rig, dash


def found(rig: ServoRig) -> list[int]:
    """Return the ticks in which a motor fault was found."""
    return [tick for tick, finding in rig.found if finding.alarm is Alarm.ACTUATOR]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "joint", "side"),
    [("puma560", 0, 1.0), ("puma560", 1, -1.0), ("puma560", 4, 1.0), ("k1607", 3, 1.0)],
)
def test_a_motor_off_at_top_speed_is_found_in_time(name: str, joint: int, side: float) -> None:
    rig, dash = dashing(name, joint, side)
    rig.inject("actuator-off", joint=-1)
    rig.run(150, dash.at)
    assert found(rig)[0] - rig.acted[0] <= 5
    assert (rig.status.stopped, rig.status.braked) == (1, 1)
    assert (rig.status.violations, rig.servo.arm.first_violation) == (0, "")
    assert rig.status.reason.startswith("motor of '")


@pytest.mark.slow
def test_a_failed_motor_is_retried_and_set_points_are_followed_once_it_works() -> None:
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


@pytest.mark.slow
@pytest.mark.parametrize(("reaction", "braked"), [("hold", 0), ("stop", 1)])
def test_with_a_weak_motor_the_arm_may_ramp_to_rest(reaction: str, braked: int) -> None:
    rig, dash = dashing("puma560", 0, 1.0, on_actuator_fault=reaction)
    rig.inject("actuator-saturated", joint=0, part=0.1)
    rig.run(195, dash.at)
    assert len(found(rig)) == 1
    assert (rig.status.stopped, rig.status.braked) == (1, braked)
    assert np.abs(rig.status.velocity).max() < 0.01
    assert rig.status.violations == 0


def test_a_dead_motor_is_found_where_dry_friction_changes_sign_and_hides_it() -> None:
    rig = ServoRig(*config("puma560"))
    home = np.array(config("puma560")[0].home)
    # The first joint comes to rest while the others continue.
    first, others = Course(home, home + 0.4, 1.0), Course(home, home + 0.4, 2.0)
    turning = np.array([True, *[False] * 5])

    def motion(time_s: float) -> tuple[Array, Array]:
        (q1, v1), (q, v) = first.at(time_s), others.at(time_s)
        return np.where(turning, q1, q), np.where(turning, v1, v)

    rig.run(380, motion)
    begun = rig.inject("actuator-off", joint=0)
    rig.run(10, motion)
    assert [tick - begun for tick in found(rig)] == [4]


CELL = cell("puma560")
RESTING = np.zeros((2, 6))
REST = RESTING[0]
HELD_BY_FRICTION = math.tanh(2.0) * CELL.model.dof_frictionloss[CELL.dof]
"""Torques that dry friction absorbs at rest, N m."""


class Bench:
    """An arm at rest at home, with unexplained torques that the test sets."""

    def __init__(self) -> None:
        self.monitor = ActuatorMonitor(CELL, following=0.02, period_s=TICK_S)
        self.terms = Dynamics(CELL).terms(CELL.home, REST)
        self.monitor.check_cycle(RESTING, RESTING, self.terms, False)

    def leave(self, cycles: int, **left: float) -> list[Finding]:
        """Leave these torques over, N m, by joint from `j1` on; return what is found."""
        over = REST.copy()
        for joint, torque in left.items():
            over[int(joint[1:]) - 1] = torque
        found = []
        for _ in range(cycles):
            taken = np.where(over, np.copysign(HELD_BY_FRICTION, over), 0.0)
            self.monitor.torque[:] = self.terms.bias + over + taken
            self.monitor.begin_cycle()
            found.append(self.monitor.check_cycle(RESTING, RESTING, self.terms, False))
        return [finding for finding in found if finding is not None]


def test_pressing_a_part_on_its_support_is_not_a_motor_fault() -> None:
    bench = Bench()
    assert bench.leave(10, j2=-20.0, j3=-3.9, j5=1.1) == []
    # The arm has turned to it: only the wrist still presses, a little more in every cycle.
    for cycle in range(40):
        assert bench.leave(1, j5=1.6 + 0.01 * cycle) == []


def test_a_motor_that_lacks_more_than_a_contact_explains_is_found_while_pressing() -> None:
    bench = Bench()
    bench.leave(10, j2=-2.5, j3=-1.4, j5=2.2)
    much = (MAX_CONTACT_FRACTION + 0.01) * CELL.bounds.torque[1]
    found = bench.leave(SURE_CYCLES, j2=much, j3=-9.8, j5=0.4)
    assert [finding.subject for finding in found] == [1]


def test_a_dead_motor_is_found_while_two_joints_turn_although_a_part_is_held() -> None:
    monitor = ActuatorMonitor(CELL, following=0.02, period_s=TICK_S)
    turning = np.array([0.3, 0.0, 0.0, 0.3, 0.0, 0.0])
    state = np.array([REST, turning])
    terms = Dynamics(CELL).terms(CELL.home, turning)
    # Less than contacts may exert while no more than one joint turns.
    missing = 0.95 * MAX_RESTING_CONTACT_FRACTION * CELL.bounds.torque * [1, 0, 0, 0, 0, 0]
    dry = np.sign(turning) * CELL.model.dof_frictionloss[CELL.dof]
    monitor.torque[:] = terms.bias + dry + missing
    found = []
    for _ in range(SURE_CYCLES + 2):
        found.append(monitor.check_cycle(state, state, terms, holds=True))
        monitor.begin_cycle()
    assert [finding.subject for finding in found if finding] == [0]
