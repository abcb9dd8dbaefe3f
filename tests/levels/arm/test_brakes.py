"""The brakes of the simulated arm act without motors, engage by themselves, and keep the limits."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array
from rack.levels.arm import SimulatedArm
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics
from tests.levels.arms import CLOCK_NS, cell, config, save_state


def build_moving_arm(every: int = 1) -> tuple[SimulatedArm, Cell, Callable[[], Array]]:
    """Return an arm under way, and torques that would keep it under way."""
    made = cell("puma560")
    made.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    arm, dynamics = SimulatedArm(made, config("puma560")[1], CLOCK_NS, every), Dynamics(made)
    side = np.where(np.arange(len(made.home)) % 2, -1.0, 1.0) * made.limits.acceleration

    def torque() -> Array:
        sensed = arm.sense()
        inertia, bias = dynamics.terms(sensed.position, sensed.velocity)
        return np.asarray(inertia @ (0.5 * side) + bias)

    for _ in range(80):
        arm.drive(torque(), 0.0)
        arm.step(1)
    assert np.abs(arm.sense().velocity).max() > 0.2
    return arm, made, torque


@pytest.mark.parametrize("every", [1, 3])
def test_the_brakes_engage_after_two_torque_cycles_without_a_command(every: int) -> None:
    arm, _, torque = build_moving_arm(every)
    arm.drive(torque(), 0.0)
    arm.step(2 * every)
    assert not arm.braked
    arm.step(1)
    assert arm.braked
    assert not arm.torque.any()


@pytest.mark.slow
def test_engaged_brakes_stop_and_hold_an_arm_with_all_motors_off() -> None:
    arm, _, torque = build_moving_arm()
    arm.weaken(np.zeros(6))
    arm.brake()
    arm.step(600)
    assert np.abs(arm.sense().velocity).max() < 1e-3
    rest = arm.sense().position.copy()
    arm.step(400)
    assert arm.sense().position == pytest.approx(rest, abs=1e-3)
    assert arm.violations == 0
    for _ in range(60):
        arm.drive(torque(), 0.0)
        arm.step(1)
    assert np.abs(arm.sense().position - rest).max() > 0.02  # without brakes it falls


def test_an_arm_restored_with_engaged_brakes_continues_bit_for_bit() -> None:
    arm, _, _ = build_moving_arm()
    arm.brake()
    arm.step(30)
    arm.brake()
    saved = save_state(arm)
    again = SimulatedArm(cell("puma560"), config("puma560")[1], CLOCK_NS)
    again._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    again.restore(saved)
    for one in (arm, again):
        one.step(300)
    assert saved.braked == 1
    assert save_state(arm).raw == save_state(again).raw


@pytest.mark.parametrize(
    ("value", "alarm"),
    [(np.nan, Alarm.COMMAND_INVALID), (np.inf, Alarm.COMMAND_INVALID), (1e3, Alarm.COMMAND_LIMIT)],
)
def test_an_invalid_torque_engages_the_brakes_and_is_reported(value: float, alarm: Alarm) -> None:
    arm, made, torque = build_moving_arm()
    command = torque()
    command[3] = -value
    found = arm.drive(command, 0.0)
    assert found is not None
    assert (found.alarm, found.subject) == (alarm, 3)
    assert arm.braked
    assert not arm._data.ctrl[made.actuators].any()
    # One at its limit is a command like any other.
    assert arm.drive(made.bounds.torque.copy(), 0.0) is None
    assert not arm.braked


def test_the_limit_monitor_counts_every_step_beyond_a_limit_and_names_the_first() -> None:
    arm, made, torque = build_moving_arm()
    arm._data.qvel[made.dof[1]] = 3.0
    arm.drive(torque(), 0.0)
    arm.step(1)
    assert 1 <= arm.violations <= 5
    assert arm.first_violation.startswith("velocity 2.")
    assert "of joint 'j2' at 0.2000 s, step 0; -1.51 to 1.51 is permitted" in arm.first_violation
