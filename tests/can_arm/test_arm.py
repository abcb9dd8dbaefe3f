"""The rack's side of the example `can-arm`: enabling, and what it takes for samples."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.watch.alarms import Alarm
from rack.levels.arm import DriveState
from rack.levels.operator import Operation
from tests.can_arm.rig import DrivenRig
from tests.levels.servo.rig import TICK_S


def test_drives_are_switched_on_step_by_step_and_follow(rig: DrivenRig) -> None:
    seen = []
    for _ in range(12):
        rig.run(1)
        seen.append((rig.arm.state.name, rig.powers[0]))
    assert list(dict.fromkeys(seen)) == [
        ("ENABLING", "SWITCH_ON_DISABLED"),
        ("ENABLING", "READY_TO_SWITCH_ON"),
        ("ENABLING", "SWITCHED_ON"),
        ("ENABLED", "OPERATION_ENABLED"),
    ]
    ages = rig.swing(600)
    assert set(ages) == {1}
    assert rig.alarms() == [Alarm.BRAKES_OPENED]
    assert np.abs(np.array(rig.positions) - np.array(rig.targets)).max() < 2e-4


@pytest.mark.slow
def test_a_disabled_arm_stays_where_it_is_and_goes_on_when_enabled(swinging: DrivenRig) -> None:
    rig = swinging
    rig.operator.say("servo", Operation.DISABLE)
    rig.swing(80)
    assert (rig.arm.state, set(rig.powers)) == (DriveState.DISABLED, {"SWITCH_ON_DISABLED"})
    rest = rig.mechanics.position.copy()
    rig.swing(100)
    assert (rig.mechanics.position == rest).all()
    rig.operator.say("servo", Operation.ENABLE)
    rig.swing(20)
    assert (rig.arm.state, rig.status.braked) == (DriveState.ENABLED, 0)


@pytest.mark.slow
def test_a_restarted_board_finds_the_drives_where_they_are(swinging: DrivenRig) -> None:
    rig = swinging
    rig.restart()
    # It brakes before the first report of a drive comes.
    rig.step()
    rig.arm.brake()
    assert rig.swing(60)[-1] == 1
    assert (rig.arm.state, rig.status.braked, rig.arm.fault) == (DriveState.ENABLED, 0, "")


@pytest.mark.slow
def test_drives_that_do_not_answer_are_a_fault_after_a_while(rig: DrivenRig) -> None:
    rig.drives.pop()
    rig.run(int(5.6 / TICK_S))
    assert (rig.arm.state, rig.arm.fault) == (DriveState.FAULT, "drive 2: no heartbeat")


@pytest.mark.slow
def test_an_arm_is_not_enabled_on_what_a_drive_reported_once(swinging: DrivenRig) -> None:
    rig = swinging
    rig.disturb("UNPLUGGED", 60.0)
    rig.swing(210)
    assert rig.arm.fault == "drive 2: no heartbeat"
    rig.operator.say("servo", Operation.RESET)
    rig.swing(10)
    rig.operator.say("servo", Operation.ENABLE)
    rig.swing(100)
    assert (rig.arm.state, rig.powers[0]) == (DriveState.ENABLING, "SWITCHED_ON")


@pytest.mark.slow
def test_a_bus_that_babbles_does_not_lengthen_a_cycle(swinging: DrivenRig) -> None:
    rig = swinging
    wire = rig.example.wire
    with wire.open_bus() as bus:
        for _ in range(500):
            wire.send(bus, wire.HEARTBEAT, 99, b"\5")
        assert len(list(wire.receive(rig.arm._bus))) == wire.MOST_FRAMES
    rig.swing(100)
    assert (rig.arm.fault, rig.status.braked) == ("", 0)


@pytest.mark.slow
def test_reports_from_another_run_are_no_samples(swinging: DrivenRig) -> None:
    rig = swinging
    wire = rig.example.wire
    for tick in (rig.arm.tick + 1000, 3):
        strange = wire.Report(tick, wire.Power.OPERATION_ENABLED, 0, 10**6, 0)
        rig.send(wire.STATUS, 1, wire.REPORT.pack(*strange))
        rig.swing(1)
        assert rig.arm.sense().position[0] != 1.0
        assert rig.age == 1
