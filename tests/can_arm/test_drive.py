"""Drives of the example `can-arm`: their states, their clock, the joints that they step, and what
they do when the rack is silent."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rack.levels.algebra import solve
from rack.levels.robot.dynamics import Dynamics
from tests.can_arm.rig import PATIENCE_TICKS, DrivenRig
from tests.levels.arms import cell as shipped_cell


@pytest.mark.parametrize(
    ("power", "word", "then"),
    [
        ("SWITCH_ON_DISABLED", "SHUT_DOWN", "READY_TO_SWITCH_ON"),
        ("READY_TO_SWITCH_ON", "SWITCH_ON", "SWITCHED_ON"),
        ("SWITCHED_ON", "ENABLE_OPERATION", "OPERATION_ENABLED"),
        ("OPERATION_ENABLED", "ENABLE_OPERATION", "OPERATION_ENABLED"),
        ("OPERATION_ENABLED", "SWITCH_ON", "SWITCHED_ON"),
        ("OPERATION_ENABLED", "SHUT_DOWN", "READY_TO_SWITCH_ON"),
        ("OPERATION_ENABLED", "DISABLE_VOLTAGE", "SWITCH_ON_DISABLED"),
        ("OPERATION_ENABLED", "RESET_FAULT", "OPERATION_ENABLED"),
        ("SWITCH_ON_DISABLED", "SWITCH_ON", "SWITCH_ON_DISABLED"),
        ("SWITCH_ON_DISABLED", "ENABLE_OPERATION", "SWITCH_ON_DISABLED"),
        ("READY_TO_SWITCH_ON", "ENABLE_OPERATION", "READY_TO_SWITCH_ON"),
        ("FAULT", "ENABLE_OPERATION", "FAULT"),
        ("FAULT", "DISABLE_VOLTAGE", "FAULT"),
        ("FAULT", "RESET_FAULT", "SWITCH_ON_DISABLED"),
    ],
)
def test_a_drive_changes_its_state_by_commands(
    example: Any, power: str, word: str, then: str
) -> None:
    wire = example.wire
    assert example.drive.next_power(wire.Power[power], wire.Control[word]).name == then


def test_a_clock_sees_through_syncs_that_come_late(example: Any) -> None:
    clock = example.drive.TickClock(0.002)
    late = [0.0, 0.0007, 0.004, 0.0, 0.0001]
    times = [clock.at(tick, 10.0 + 0.002 * tick + late_s) for tick, late_s in enumerate(late)]
    assert times == pytest.approx([10.0, 10.002, 10.004, 10.006, 10.008], abs=1e-6)
    # Very late, or of another run: believed, until one comes earlier.
    assert clock.at(5, 10.110) == pytest.approx(10.110, abs=1e-6)
    assert clock.at(6, 10.012) == pytest.approx(10.012, abs=1e-6)


@pytest.mark.slow
def test_joints_stepped_apart_move_as_the_whole_arm_does(example: Any) -> None:
    cell = shipped_cell("k1607")
    dynamics = Dynamics(cell)
    random = np.random.default_rng(3)
    mechanics = example.mechanics.Mechanics(cell, 0.0)
    joints = [example.mechanics.Joint(mechanics, number) for number in range(7)]
    position, velocity = cell.home.copy(), np.zeros(7)
    for tick in range(500):
        inertia, bias = dynamics.terms(position, velocity)
        swing = np.sin(0.01 * tick + np.arange(7))
        torque = bias + inertia @ (swing - 2.0 * velocity)
        # Commands come some time after the tick, and drives look at them one after the other.
        for number in random.permutation(7):
            joints[number].advance(tick * 2e-3)
            joints[number].drive(torque)
        for _ in range(20):
            inertia, bias = dynamics.terms(position, velocity)
            velocity += 1e-4 * solve(inertia, torque - bias - dynamics.friction(velocity))
            position += 1e-4 * velocity
    for joint in joints:
        joint.advance(1.0)
    assert np.abs(position - cell.home).max() > 0.1
    assert np.abs(mechanics.position - position).max() < 2e-3


@pytest.mark.slow
def test_drives_brake_when_the_rack_says_nothing(swinging: DrivenRig) -> None:
    rig = swinging
    rig.rack.lose("servo", 30)
    seen = []
    for _ in range(30):
        rig.step()
        seen.append(rig.powers[0])
    # The last command is of the tick before.
    assert seen.index("SWITCHED_ON") + 1 in (PATIENCE_TICKS - 1, PATIENCE_TICKS)
    rig.swing(60)
    assert (rig.powers[0], rig.status.braked, rig.arm.fault) == ("OPERATION_ENABLED", 0, "")


@pytest.mark.slow
def test_drives_that_miss_the_racks_heartbeat_are_at_fault(swinging: DrivenRig) -> None:
    rig = swinging
    rig.rack.lose("servo", 240)
    for _ in range(240):
        rig.step()
    assert set(rig.powers) == {"FAULT"}
    rig.swing(5)
    assert rig.arm.fault == "drive 1: no heartbeat from the rack (0x8130)"
