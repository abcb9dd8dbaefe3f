"""A standby takes over the mailboxes of its task: in lockstep without any difference in what is
written, in real time with at most one message missing."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.standby import ReplicatedTask, list_standbys
from rack.backplane.trace import open_trace_ring
from rack.backplane.words import Block, System
from rack.boards import Rack
from rack.boards.config import load
from rack.boards.config.schema import RackConfig
from tests.boards.config.mistakes import read_config
from tests.boards.conftest import PLAIN, PLANNED, UNJUDGED, MakeConfig
from tests.boards.runs import digest_of, end_of, faulty, kill
from tests.processes import wait_until
from tests.tools.command_line import rack

STANDBY = "board.wave.standby={slot=9,core=0}"
TWO = "board.wave.standby=[{slot=9,core=0},{slot=10,core=1}]"
SOON = "supervision.lockstep_restart_s=0.05"
MANY = "supervision.restarts=1000"
SLOW = ("clock.mode=realtime", "clock.speed=0.01", UNJUDGED, MANY)
SECONDS = 0.5
AFTER = 3
"""Ticks after a hand-over in which messages are counted."""
MISSING = 1
"""Number of messages that a reader may miss in a hand-over in real time."""


def run(config: RackConfig) -> tuple[str, ReplicatedTask, list[str]]:
    """Run a rack in lockstep. Returns its digest, its replicated task, and its alarms' codes."""
    with Rack(config) as rack:
        outcome = rack.run(SECONDS)
        (task,) = list_standbys(rack.segment)
        pids = [rack.segment.get_block(copy.name)[Block.PID] for copy in task.copies]
        assert [copy.pid for copy in task.copies] == pids
        found = [event.code for event in rack.events if event.kind == "detection"]
    return outcome.digest, task, found


KILLED = kill("wave", 30)
HANG = {"kind": "hang", "board": "wave", "tick": 30}
OVERLOAD = {"kind": "overrun", "board": "wave", "tick": 30, "cycles": 3, "by": 1.5}
CASES: Mapping[str, tuple[str, tuple[Mapping[str, Any], ...], str, str, int]] = {
    "none": (STANDBY, (), "wave", "none", 0),
    "killed": (STANDBY, (KILLED,), "wave.standby", "lost", 1),
    "killed standby": (STANDBY, (kill("wave.standby", 30),), "wave", "none", 0),
    "killed twice": (STANDBY, (KILLED, kill("wave.standby", 80)), "wave", "lost", 2),
    "hanging": (STANDBY, (HANG,), "wave.standby", "stopped", 1),
    "late": (STANDBY, (OVERLOAD,), "wave.standby", "late", 1),
    "two of three killed": (TWO, (KILLED, kill("wave.standby", 32)), "wave.standby2", "lost", 2),
}
"""Standbys, faults, then the active copy at the end, the last reason and number of hand-overs."""


@pytest.fixture(scope="module")
def plain() -> str:
    """Digest of the rack without standbys and faults."""
    return digest_of(read_config(PLANNED, [f"name=test-plain-{os.getpid()}"]), SECONDS)


@pytest.mark.parametrize("case", CASES)
def test_in_lockstep_nobody_can_tell_which_copy_has_written(
    case: str, config: MakeConfig, plain: str
) -> None:
    standby, faults, active, reason, count = CASES[case]
    digest, task, alarms = run(faulty(config(standby, SOON, UNJUDGED, text=PLANNED), *faults))
    assert (task.active.name, task.reason, task.hand_overs) == (active, reason, count)
    assert digest == plain
    assert set(alarms) <= {"hang", "late"}
    assert [copy.name for copy in task.copies if copy.is_active] == [active]
    assert all(copy.aligned_since is not None for copy in task.copies if not copy.is_active)


@pytest.mark.slow
def test_a_kill_from_outside_at_any_moment_leaves_the_digest(
    config: MakeConfig, plain: str
) -> None:
    with Rack(config(STANDBY, SOON, UNJUDGED, MANY, text=PLANNED)) as rack:
        words = rack.segment.words
        rack.start(SECONDS)
        for number, tick in enumerate((20, 70, 120), start=1):
            wait_until(lambda tick=tick: not rack.watch(0.0) or words[System.TICK] > tick)
            (task,) = list_standbys(rack.segment)
            if any(copy.is_lost for copy in task.copies):
                continue  # on a fast machine the run was ahead of the last restart
            os.kill(task.active.pid, signal.SIGKILL)
            wait_until(
                lambda number=number: (
                    not rack.watch(0.0) or list_standbys(rack.segment)[0].hand_overs >= number
                )
            )
        outcome = end_of(rack)
        (task,) = list_standbys(rack.segment)
    assert task.hand_overs >= 1
    assert outcome.digest == plain


@pytest.mark.thorough
@pytest.mark.alone
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["kill", "stop"])
def test_in_real_time_readers_miss_at_most_one_message(
    config: MakeConfig, number: signal.Signals
) -> None:
    with Rack(config(STANDBY, *SLOW, text=PLANNED)) as rack:
        words = rack.segment.words
        rack.start(0.05)
        wait_until(lambda: not rack.watch(0.0) or words[System.TICK] >= 5)
        (before,) = list_standbys(rack.segment)
        os.kill(before.active.pid, number)

        def has_taken_over() -> bool:
            # The name of the active copy is stored last.
            return list_standbys(rack.segment)[0].active.name != before.active.name

        wait_until(lambda: not rack.watch(0.0) or has_taken_over())
        (after,) = list_standbys(rack.segment)
        if number == signal.SIGSTOP:
            # It may store what it was about to, which no reader accepts.
            os.kill(before.active.pid, signal.SIGCONT)
        words[System.STOP_TICK] = max(words[System.TICK] + 1, after.since_tick + AFTER)
        end_of(rack)
        rows = MailboxRing(rack.segment, "wave.status").read_new_rows().rows
    ticks, epochs = rows["tick"], rows["epoch"] & 0xFFFFFFFF
    assert after.active.name != before.active.name
    assert after.reason in ("lost", "stopped", "late")
    assert np.diff(ticks).min() >= 1
    around = (ticks >= 4) & (ticks <= after.since_tick + AFTER)
    assert np.diff(ticks[around]).max() <= 1 + MISSING
    assert (np.diff(epochs) >= 0).all()
    assert epochs[-1] > epochs[0]


CLOCK = "clock.standby={slot=9,core=0}"


def clock_ticks(rack: Rack) -> np.ndarray:
    """Return the release ticks of the wave's cycles, as its trace has them."""
    return open_trace_ring(rack.segment, "wave").read_new_rows().rows["tick"]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["kill", "stop"])
def test_the_standby_of_the_clock_gives_every_tick_once(
    config: MakeConfig, plain: str, number: signal.Signals
) -> None:
    with Rack(config(CLOCK, UNJUDGED, MANY, text=PLANNED)) as rack:
        words = rack.segment.words
        rack.start(SECONDS)
        wait_until(lambda: words[System.TICK] > 20)
        first = words[System.CLOCK_PID]
        os.kill(first, number)
        wait_until(lambda: not rack.watch(0.0) or words[System.CLOCK_PID] != first)
        outcome = end_of(rack)
        ticks = clock_ticks(rack)
        ends = [event.text for event in rack.events if event.kind == "died"]
    assert outcome.cause == "time over"
    assert ends == ["board 'clock' ended: signal SIGKILL"]
    assert outcome.digest == plain
    assert (np.diff(ticks) == 1).all()


@pytest.mark.thorough
@pytest.mark.alone
def test_in_real_time_the_standby_of_the_clock_continues_its_grid(config: MakeConfig) -> None:
    with Rack(config(CLOCK, *SLOW, text=PLANNED)) as rack:
        words = rack.segment.words
        rack.start(0.0325)
        wait_until(lambda: not rack.watch(0.0) or words[System.TICK] >= 5)
        first, epoch_ns = words[System.CLOCK_PID], words[System.EPOCH_NS]
        os.kill(first, signal.SIGKILL)
        outcome = end_of(rack)
        ticks = clock_ticks(rack)
        assert words[System.CLOCK_PID] != first
        assert words[System.EPOCH_NS] == epoch_ns
    assert outcome.cause == "time over"
    around = ticks[(ticks >= 4) & (ticks <= 12)]
    assert np.diff(around).min() >= 1
    assert np.diff(around).max() <= 1 + 2


def test_a_level_that_is_not_deterministic_cannot_be_compared(
    config: MakeConfig, tmp_path: Path
) -> None:
    text = PLAIN.replace("wave_levels:Wave", "wave_levels:Lottery")
    path = tmp_path / "lottery.toml"
    path.write_text(config(STANDBY, "board.wave.compare=true", text=text).to_toml_text())
    done = rack("run", path, "--seconds", 0.5, "--no-record")
    line = (
        "board.wave.compare = true: the level is not deterministic: 'wave.status': a standby"
        " computes another value, at the start"
    )
    assert (done.returncode, line in done.stderr) == (2, True), done.stderr
    assert "Traceback" not in done.stderr


def test_an_operator_switches_without_a_gap(config: MakeConfig, plain: str) -> None:
    commands = 'command=[{level="wave",what="switch",tick=50},{level="wave",what="switch",tick=90}]'
    digest, task, alarms = run(config(STANDBY, commands, text=PLANNED))
    assert (task.active.name, task.reason, task.since_tick) == ("wave", "commanded", 90)
    assert task.hand_overs == 2
    assert [(copy.name, copy.slot) for copy in task.copies] == [("wave", 2), ("wave.standby", 9)]
    assert (digest, alarms) == (plain, [])


def test_a_switch_while_no_standby_is_ready_is_reported(config: MakeConfig) -> None:
    commands = 'command=[{level="wave",what="switch",tick=35}]'
    with Rack(faulty(config(STANDBY, commands, text=PLANNED), kill("wave.standby", 30))) as rack:
        rack.run(SECONDS)
        assert list_standbys(rack.segment)[0].hand_overs == 0
        (event,) = [event for event in rack.events if event.code == "not_switched"]
    assert (event.tick, event.board, event.kind) == (35, "wave", "command")
    assert event.text == "'wave' remains active: no standby has its state"


ARM_S = 6.75
"""The first path is planned, and part of it driven."""
ARM_STANDBY = ("board.servo.standby={slot=9,core=0}", "board.servo.compare=true")
FIRST, SECOND = 2300, 2600
ARM_FAULTS: Mapping[str, tuple[Mapping[str, Any], ...]] = {
    "no fault": (),
    "two kills": (kill("servo", FIRST), kill("servo.standby", SECOND)),
    "a hang": ({"kind": "hang", "board": "servo", "tick": FIRST},),
}


@pytest.fixture(scope="module")
def plain_arm() -> str:
    return digest_of(load("nasrem", ["clock.mode=lockstep", "name=test-plain-arm"]), ARM_S)


@pytest.mark.thorough
@pytest.mark.parametrize("case", ARM_FAULTS)
def test_the_standby_of_a_servo_level_moves_the_arm_as_if_nothing_had_happened(
    case: str, rack_name: str, plain_arm: str
) -> None:
    config = load("nasrem", ["clock.mode=lockstep", f"name={rack_name}", *ARM_STANDBY])
    with Rack(faulty(config, *ARM_FAULTS[case])) as rack:
        digest = rack.run(ARM_S).digest
        states = MailboxRing(rack.segment, "servo.state").read_new_rows().rows
        events = rack.events
    assert digest == plain_arm
    assert not [event for event in events if event.code in ("brakes_closed", "demand", "differs")]
    assert states["tick"][0] < FIRST
    assert (np.diff(states["tick"]) == 1).all()
    assert not states["message"]["braked"].any()
    # The arm moves in both hand-overs.
    speed = np.abs(states["message"]["velocity"]).max(axis=1)
    for tick in (FIRST, SECOND):
        assert speed[states["tick"] == tick] > 0.01
