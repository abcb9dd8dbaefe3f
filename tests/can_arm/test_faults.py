"""Troubles on the wire and faults of drives in the example `can-arm`: the rack's reaction."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.watch.alarms import Alarm
from rack.levels.arm import DriveState
from rack.levels.messages import Error
from rack.levels.operator import Operation
from tests.can_arm.rig import DrivenRig


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seconds", "size", "found", "age"),
    [
        ("UNPLUGGED", 0.1, 0.0, [(3, Alarm.SENSOR_SILENT), (3, Alarm.BRAKES_CLOSED)], 42),
        ("LATE", 0.2, 0.003, [], 3),
        (
            "LATE",
            0.2,
            0.015,
            [(4, Alarm.SENSOR_SILENT), (4, Alarm.BRAKES_CLOSED), (8, Alarm.SENSOR_LATE)],
            6,
        ),
        ("LOST", 0.25, 0.05, [], 3),
        ("DOUBLED", 0.25, 0.0, [], 1),
    ],
)
def test_after_a_short_trouble_on_the_wire_the_arm_goes_on_by_itself(
    swinging: DrivenRig,
    kind: str,
    seconds: float,
    size: float,
    found: list[tuple[int, Alarm]],
    age: int,
) -> None:
    rig = swinging
    since = rig.disturb(kind, seconds, size)
    ages = rig.swing(200)
    brakings = len(found) > 0
    assert rig.after(since)[: len(found)] == found
    assert len(rig.after(since)) == len(found) + brakings
    assert max(ages) <= age
    assert (rig.arm.fault, rig.status.braked, rig.status.violations) == ("", 0, 0)
    assert rig.powers == ["OPERATION_ENABLED"] * 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seconds", "within", "fault"),
    [
        ("UNPLUGGED", 0.8, 205, "drive 2: no heartbeat"),
        ("BUS_OFF", 0.05, 25, "drive 2: was off the bus (0x8140)"),
        ("TOO_HOT", 0.05, 5, "drive 2: too hot (0x4310)"),
        ("RESET", 0.0, 5, "drive 2: has lost its power"),
    ],
)
def test_after_a_fault_of_a_drive_the_arm_waits_for_its_operator(
    swinging: DrivenRig, kind: str, seconds: float, within: int, fault: str
) -> None:
    rig = swinging
    if kind == "RESET":
        rig.drives[1] = rig.booted(2)
    else:
        rig.disturb(kind, seconds)
    rig.swing(within)
    assert (rig.arm.state, rig.arm.fault, rig.status.braked) == (DriveState.FAULT, fault, 1)
    assert (rig.status.error, fault in rig.status.reason) == (Error.DRIVES, True)
    rig.swing(200)
    assert rig.powers[0] == "SWITCH_ON_DISABLED"
    assert np.abs(rig.mechanics.velocity).max() < 1e-9
    rig.operator.say("servo", Operation.RESET)
    rig.swing(20)
    assert (rig.arm.state, rig.arm.fault) == (DriveState.DISABLED, "")
    assert set(rig.powers) == {"SWITCH_ON_DISABLED"}
    rig.operator.say("servo", Operation.ENABLE)
    rig.swing(40)
    assert (rig.arm.state, rig.status.braked) == (DriveState.ENABLED, 0)
    assert rig.status.violations == 0


@pytest.mark.slow
def test_a_reset_without_a_fault_changes_nothing(swinging: DrivenRig) -> None:
    rig = swinging
    rig.operator.say("servo", Operation.RESET)
    rig.swing(20)
    assert rig.alarms() == [Alarm.BRAKES_OPENED]
    # Nor does one that has just helped hide the next fault.
    rig.disturb("TOO_HOT", 0.02)
    rig.swing(20)
    rig.operator.say("servo", Operation.RESET)
    rig.swing(20)
    rig.operator.say("servo", Operation.ENABLE)
    rig.swing(20)
    assert rig.arm.state is DriveState.ENABLED
    rig.drives[1] = rig.booted(2)
    rig.swing(20)
    assert rig.arm.fault == "drive 2: has lost its power"
