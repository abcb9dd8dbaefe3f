"""The arm hardware of the example in a rack of real processes, in lockstep: off its home, enabled
by command, its drives in fault, its board killed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.message import Message, State
from rack.boards.config import load
from rack.boards.crate.rack import Rack
from rack.boards.events import Event, Outcome
from rack.levels.messages import Error

EXAMPLE = Path(__file__).parents[1] / "configs" / "examples" / "own-hardware" / "hardware.toml"
NAME = f"test-hardware-{os.getpid()}"
AWAY = "robot.start=[0.05, -0.75, 0.05, -1.45, 0.05, -0.8, 0.05]"


def given(what: str, at: float) -> str:
    return f'{{ level = "servo", what = "{what}", at = {at} }}'


def ran(seconds: float, *settings: str) -> tuple[Outcome, list[Event], Message]:
    config = load(EXAMPLE, [f"name={NAME}", "clock.mode=lockstep", AWAY, *settings])
    with Rack(config) as rack:
        outcome = rack.run(seconds)
        return outcome, rack.events, open_observer(rack.segment, "servo.status").peek().message


@pytest.mark.thorough
def test_hardware_is_enabled_homed_faulted_reset_and_killed_and_goes_on() -> None:
    commands = (
        given("enable", 0.2),
        given("disable", 3.0),
        given("enable", 3.2),
        given("reset", 6.5),
        given("enable", 6.6),
    )
    faults = (
        '{ kind = "actuator-off", board = "servo", joint = 2, at = 6.0, for = "200ms" }',
        '{ kind = "kill", board = "servo", at = 8.0 }',
    )
    outcome, events, servo = ran(
        11.0,
        "robot.calibration.homing=true",
        f"command=[{', '.join(commands)}]",
        f"fault=[{', '.join(faults)}]",
    )
    closed = [(e.tick, e.text) for e in events if e.code == "brakes_closed"]
    opened = [e.tick for e in events if e.code == "brakes_opened"]
    # The drives take 500 ticks to find their reference and be ready, 100 when they know it.
    assert opened[:3] == [80 + 501, 1280 + 101, 2640 + 101]
    (disabled, by_operator), (faulted, by_drives), (killed, by_kill) = closed
    assert (disabled, by_operator) == (1201, "brakes engaged: disabled")
    assert 2400 <= faulted <= 2402
    assert by_drives == "brakes engaged: drives"
    assert 3200 < killed <= 3400  # found by the board that follows
    assert by_kill.startswith("brakes engaged: no torque")
    assert [e.code for e in events if e.kind == "detection" and "sensor" in e.code] == []
    assert (servo.state, servo.error, servo.braked) == (State.EXECUTING, 0, 0)
    assert not outcome.faults


@pytest.mark.slow
def test_hardware_that_nobody_enables_stays_disabled_through_a_kill_and_the_run_says_why() -> None:
    outcome, events, servo = ran(1.5, 'fault=[{ kind = "kill", board = "servo", at = 0.5 }]')
    why = f"disabled; to enable: rack command {NAME} servo enable"
    assert (servo.state, servo.error, servo.reason) == (State.HOLDING, Error.DISABLED, why)
    assert not outcome.is_success
    assert f"level 'servo': {why}" in outcome.faults
    assert "brakes_opened" not in [event.code for event in events]
