"""The servo level when the safety of the rack demands a stop, and when cycles are missed."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.watch.alarms import Alarm
from rack.levels.level import Demand
from tests.levels.arms import config
from tests.levels.servo_rig import TICK_S, Course, ServoRig

GOAL = np.array([0.6, 1.0, -2.6, 0.4, -1.2, 0.5])


def rig_under_way() -> tuple[ServoRig, Course]:
    rig, move = ServoRig(*config("puma560")), Course(np.array(config("puma560")[0].home), GOAL, 2.0)
    rig.run(400, move.at)
    return rig, move


def test_brake_closes_the_brakes_in_its_own_cycle() -> None:
    rig, move = rig_under_way()
    rig.rack.demand = Demand.BRAKE
    rig.run(1, move.at)
    status = rig.status
    assert (status.stopped, status.braked, status.holding, status.demand) == (1, 1, 1, Demand.BRAKE)
    assert status.reason == "demand 'brake' on the arm, until boards and emergency stop are in order"
    assert not status.torque.any()
    rig.run(200, move.at)
    assert np.abs(rig.status.velocity).max() < 1e-3
    assert rig.alarms() == [Alarm.BRAKES_CLOSED]


def test_stop_ramps_to_rest_within_the_acceleration_limits_and_then_brakes() -> None:
    rig, move = rig_under_way()
    limits = np.array(config("puma560")[0].acceleration)
    rig.rack.demand = Demand.STOP
    rig.run(1, move.at)
    assert (rig.status.stopped, rig.status.braked) == (1, 0)
    begin = len(rig.targets) - 2
    while not rig.status.braked:
        rig.run(1, move.at)
        assert rig.rack.tick < 700
    ramp = np.diff(np.array(rig.targets[begin:-1]), n=2, axis=0) / TICK_S**2
    assert (np.abs(ramp) <= limits * 1.01).all()
    assert np.abs(rig.status.velocity).max() < 0.02
    assert rig.alarms() == [Alarm.BRAKES_CLOSED]
    rig.rack.demand = Demand.BRAKE
    rig.run(10, move.at)
    rig.rack.demand = Demand.STOP
    rig.run(10, move.at)
    assert rig.status.braked == 1  # what has come to rest stays braked


@pytest.mark.parametrize("demand", [Demand.STOP, Demand.BRAKE])
@pytest.mark.parametrize("ticks", [1, 30, 300])
def test_afterwards_the_arm_is_taken_over_where_it_stands_and_joins_the_set_points(demand: Demand, ticks: int) -> None:
    rig, move = rig_under_way()
    limits = np.array(config("puma560")[0].acceleration)
    rig.rack.demand = demand
    rig.run(ticks, move.at)
    rig.rack.demand = Demand.NONE
    before = rig.status.position.copy()
    rig.run(1)
    assert (rig.status.stopped, rig.status.braked, rig.status.demand) == (0, 0, Demand.NONE)
    assert np.abs(rig.status.target - before).max() < 0.01
    begin = len(rig.targets)
    rig.run(-rig.rack.tick % 8)
    rig.run(1200, move.at)
    steps = np.diff(np.array(rig.targets[begin:]), n=2, axis=0) / TICK_S**2
    assert (np.abs(steps) <= 2.2 * limits).all()
    assert rig.status.position == pytest.approx(GOAL, abs=1e-3)
    assert rig.status.violations == 0
    assert set(rig.alarms()) <= {Alarm.BRAKES_CLOSED, Alarm.BRAKES_OPENED}


def test_an_arm_that_is_braked_from_the_start_stays_where_it_is_and_rings_nothing() -> None:
    rig = ServoRig(*config("puma560"))
    rig.rack.demand = Demand.BRAKE
    rig.run(100, lambda _: (GOAL, np.zeros(6)))
    assert (rig.status.braked, rig.found) == (1, [])
    assert rig.status.position == pytest.approx(config("puma560")[0].home, abs=1e-3)


@pytest.mark.parametrize(("missed", "told"), [(1, None), (2, 2), (40, 40)])
def test_brakes_that_closed_because_cycles_were_missed_are_told_once_the_servo_runs_again(
    missed: int, told: int | None
) -> None:
    rig, move = rig_under_way()
    rig.miss(missed)
    rig.run(100, move.at)
    values = [(f.finding.alarm, f.finding.value) for f in rig.found]
    assert values[:1] == ([] if told is None else [(Alarm.BRAKES_CLOSED, told)])
    assert rig.status.stopped == 0


def test_a_restarted_servo_tells_how_long_the_arm_was_without_torque() -> None:
    rig, move = rig_under_way()
    rig.miss(10_000)
    for _ in range(50):
        rig.step()
    rig.restart()
    rig.run(1, move.at)
    assert next((f.finding.alarm, f.finding.value) for f in rig.found) == (Alarm.BRAKES_CLOSED, 50)
    assert rig.status.stopped == 0


def test_a_servo_that_dies_while_the_arm_is_braked_finds_it_braked() -> None:
    rig, move = rig_under_way()
    rig.rack.demand = Demand.BRAKE
    rig.run(200, move.at)
    rest = rig.status.position.copy()
    rig.miss(10_000)
    for _ in range(3):
        rig.step()
    rig.restart()
    rig.run(100, move.at)
    assert rig.status.braked == 1
    assert rig.servo.arm.sense().position == pytest.approx(rest, abs=1e-4)
