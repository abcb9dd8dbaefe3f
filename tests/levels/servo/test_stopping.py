"""The servo level stops on a demand and when something hits the arm."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.message import State
from rack.backplane.watch.alarms import BRAKED_WITHOUT_TORQUE, Alarm
from rack.levels.algebra import Array
from rack.levels.level import Demand, Finding
from rack.levels.messages import Error
from rack.levels.tables import MotionConfig
from tests.levels.arms import config
from tests.levels.servo.rig import BRAKES, GOAL, MOVE, TICK_S, ServoRig, rig_under_way

ROBOT, SCENE = config("puma560_crossing")
HOME = np.array(ROBOT.home)
FOREARM, HAND = (0.35, 1.3), (0.5, 1.1)
"""x and z, m, at which the post meets these geoms when it moves along y."""


def turn(time_s: float) -> tuple[Array, Array]:
    """Turn about the base, back and forth."""
    base = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    return HOME + 0.6 * base * (1.0 - np.cos(2.0 * time_s)), 1.2 * base * np.sin(2.0 * time_s)


def stand(_: float) -> tuple[Array, Array]:
    return HOME, np.zeros(6)


def under_fire(at: tuple[float, float], end_y: float, speed: float) -> ServoRig:
    """Return an arm towards which the post moves from second 0.4 on."""
    (x, z), begin_y = at, 0.85
    motion = (
        MotionConfig(body="post", at=0.0, to=(x, begin_y, z), speed=50.0),
        MotionConfig(body="post", at=0.4, to=(x, end_y, z), speed=speed),
    )
    return ServoRig(ROBOT, SCENE.model_copy(update={"motion": motion}), patience=1.0)


@pytest.mark.slow
def test_a_blow_at_4_m_s_is_a_collision_and_neither_a_fault_nor_a_violation() -> None:
    rig = under_fire(FOREARM, -0.85, 4.0)
    rig.run(300, turn)
    (found,) = (f for f in rig.found if f.finding.alarm not in BRAKES)
    assert found.finding.alarm is Alarm.COLLISION
    names = {rig.servo.arm._model.geom(int(g)).name for g in found.finding[1:3]}  # type: ignore[attr-defined]
    assert "post" in names
    assert (rig.status.state, rig.status.braked) == (State.HOLDING, 1)
    assert "'post'" in rig.status.reason
    assert rig.status.violations == 0
    assert rig.status.pushed > 0
    rig.run(400, turn)
    assert (rig.status.stopped, rig.status.braked, rig.status.state) == (0, 0, State.EXECUTING)
    assert rig.alarms(*BRAKES) == [Alarm.COLLISION]


@pytest.mark.slow
def test_a_lasting_contact_is_latched_with_the_names_of_both_geoms() -> None:
    rig = under_fire(HAND, 0.2, 4.0)
    rig.run(1200, turn)
    status = rig.status
    assert (status.state, status.error, status.braked) == (State.ERROR, Error.TOUCHED, 1)
    assert status.reason.startswith("unintended contact: '")
    assert "'post'" in status.reason
    assert set(rig.alarms(*BRAKES)) == {Alarm.COLLISION, Alarm.LATCHED}


def test_a_limit_that_the_arm_itself_breaks_is_a_violation_with_or_without_a_blow() -> None:
    rig = under_fire(FOREARM, -0.85, 4.0)
    rig.run(200, stand)
    arm = rig.servo.arm
    arm._data.qvel[arm.cell.dof[1]] = 3.0
    rig.run(1, stand)
    assert rig.status.violations > 0
    assert rig.status.pushed == 0
    assert rig.status.error == Error.LIMIT


def test_a_brake_demand_engages_the_brakes_in_its_own_cycle() -> None:
    rig = rig_under_way()
    rig.rack.demand = Demand.BRAKE
    rig.run(1, MOVE.at)
    status = rig.status
    assert (status.stopped, status.braked, status.holding, status.demand) == (1, 1, 1, Demand.BRAKE)
    why = "demand 'brake' on the arm, until boards and emergency stop are in order"
    assert status.reason == why
    assert not status.torque.any()
    rig.run(200, MOVE.at)
    assert np.abs(rig.status.velocity).max() < 1e-3
    assert rig.alarms() == [Alarm.BRAKES_CLOSED]


def test_stop_ramps_to_rest_within_the_acceleration_limits_and_then_brakes() -> None:
    rig = rig_under_way()
    limits = np.array(config("puma560")[0].acceleration)
    rig.rack.demand = Demand.STOP
    rig.run(1, MOVE.at)
    assert (rig.status.stopped, rig.status.braked) == (1, 0)
    begin = len(rig.targets) - 2
    while not rig.status.braked:
        rig.run(1, MOVE.at)
        assert rig.rack.tick < 700
    ramp = np.diff(np.array(rig.targets[begin:-1]), n=2, axis=0) / TICK_S**2
    assert (np.abs(ramp) <= limits * 1.01).all()
    assert np.abs(rig.status.velocity).max() < 0.02
    assert rig.alarms() == [Alarm.BRAKES_CLOSED]
    rig.rack.demand = Demand.BRAKE
    rig.run(10, MOVE.at)
    rig.rack.demand = Demand.STOP
    rig.run(10, MOVE.at)
    assert rig.status.braked == 1  # an arm at rest stays braked


@pytest.mark.slow
@pytest.mark.parametrize(
    ("demand", "ticks"), [(Demand.STOP, 1), (Demand.STOP, 300), (Demand.BRAKE, 30)]
)
def test_after_a_stop_motion_starts_where_the_arm_is(demand: Demand, ticks: int) -> None:
    rig = rig_under_way()
    limits = np.array(config("puma560")[0].acceleration)
    rig.rack.demand = demand
    rig.run(ticks, MOVE.at)
    rig.rack.demand = Demand.NONE
    before = rig.status.position.copy()
    rig.run(1)
    assert (rig.status.stopped, rig.status.braked, rig.status.demand) == (0, 0, Demand.NONE)
    assert np.abs(rig.status.target - before).max() < 0.01
    begin = len(rig.targets)
    rig.run(-rig.rack.tick % 8)
    rig.run(1200, MOVE.at)
    steps = np.diff(np.array(rig.targets[begin:]), n=2, axis=0) / TICK_S**2
    assert (np.abs(steps) <= 2.2 * limits).all()
    assert rig.status.position == pytest.approx(GOAL, abs=1e-3)
    assert rig.status.violations == 0
    assert set(rig.alarms()) <= set(BRAKES)


@pytest.mark.parametrize("missed", [1, 2, 40])
def test_brakes_that_act_between_two_cycles_are_reported_with_their_time(missed: int) -> None:
    rig = rig_under_way()
    begun = rig.rack.tick
    rig.miss(missed)
    rig.run(missed + 5, MOVE.at)
    # The last torque was given a tick before, and the motors kept it for two.
    closed = Finding(Alarm.BRAKES_CLOSED, BRAKED_WITHOUT_TORQUE, missed, begun + 1)
    opened = Finding(Alarm.BRAKES_OPENED, BRAKED_WITHOUT_TORQUE, missed - 1)
    found = [(begun + missed, closed), (begun + missed, opened)]
    assert rig.found == (found if missed > 1 else [])
    assert rig.status.stopped == 0
