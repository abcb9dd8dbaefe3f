"""Tests `rack step`: holding a rack in lockstep between ticks, stepping it, and stopping it."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from rack.backplane.fault_table import FaultTable, Stage
from rack.backplane.segment import Segment
from rack.backplane.words import Demand, System
from tests.boards.table_racks import counting
from tests.processes import wait_until
from tests.tools.command_line import BOUND_S, rack, read_answer, read_refusal
from tests.tools.held_racks import held_rack


@pytest.fixture
def held(rack_name: str, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Launcher of a counting rack, held before tick 0."""
    with held_rack(tmp_path, rack_name) as (process, _):
        yield process


def stepped(name: str, *options: str) -> tuple[int, dict[str, str]]:
    """Step a rack, and return the tick before which it holds and the row of its counter."""
    answer = read_answer("step", name, *options)
    return answer["tick"], next(level for level in answer["levels"] if level["level"] == "counter")


@pytest.mark.slow
def test_a_held_rack_is_stepped_released_held_again_and_ends_in_order(
    held: subprocess.Popen[bytes], rack_name: str
) -> None:
    assert [stepped(rack_name)[0] for _ in range(3)] == [1, 9, 17]
    assert stepped(rack_name, "--ticks", "3")[0] == 20
    tick, level = stepped(rack_name, "--until", "counter")
    assert (tick, level["row"]) == (21, "row 3 'count up', now in 'up', table saw")
    assert stepped(rack_name, "4", "--until", "counter")[0] == 37
    tick, level = stepped(rack_name, "--until", "counter")
    assert (tick, level["row"]) == (41, "row 4 'turn', now in 'down', table saw")
    given = rack("command", rack_name, "counter", "table", "slow")
    held_at = f"the rack is held before tick 41; 'rack step {rack_name}' continues it"
    assert (
        given.stdout.replace("\n ", "") == f"command to 'counter', table slow: waits: {held_at}\n"
    )
    tick, level = stepped(rack_name, "2", "--until", "counter")
    assert (tick, level["row"]) == (49, "row 4 'rest', now in 'resting', table slow")
    text = rack("step", rack_name, "--ticks", "1").stdout
    assert f"{rack_name}: held before tick 50, 0.125 s" in text
    assert f"HELD: 'rack step {rack_name}' continues it" in rack("status", rack_name).stdout
    assert rack("resume", rack_name).stdout == f"rack '{rack_name}' continues\n"
    words = Segment.attach(rack_name).words
    wait_until(lambda: words[System.TICK] > 150 and not words[System.HELD])
    first, _ = stepped(rack_name, "--ticks", "1")
    assert stepped(rack_name, "--ticks", "1")[0] == first + 1
    assert rack("stop", rack_name).returncode == 0
    assert held.wait(BOUND_S) == 1
    assert rack("step", rack_name).returncode == 1


@pytest.mark.slow
def test_requests_to_a_held_rack_wait_until_it_continues_and_it_ends_with_its_launcher(
    held: subprocess.Popen[bytes], rack_name: str
) -> None:
    waits = f"waits: the rack is held before tick 0; 'rack step {rack_name}' continues it"
    for words, before in {
        ("command", rack_name, "counter", "table", "slow"): "command to 'counter', table slow: ",
        ("inject", rack_name, "watch", "mute"): "mute of watch: armed, ",
        ("estop", rack_name): f"rack '{rack_name}': emergency stop latched at tick 0; the arm ",
    }.items():
        done = rack(*words)
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout.replace("\n ", "").startswith(before + waits)
    segment = Segment.attach(rack_name)
    fault = FaultTable(segment).entries[0]
    assert (fault.stage, segment.words[System.DEMAND]) == (Stage.WAITING, Demand.NONE)
    assert stepped(rack_name, "2")[0] == 9
    assert (fault.stage, segment.words[System.DEMAND]) == (Stage.ACTIVE, Demand.BRAKE)
    assert rack("estop", rack_name, "--reset").stdout.replace("\n ", "") == (
        f"rack '{rack_name}': emergency stop reset at tick 8; the arm"
        f" {waits.replace('tick 0', 'tick 9')}\n"
    )
    # Held, it ends with its launcher.
    clock = segment.words[System.CLOCK_PID]
    os.kill(held.pid, signal.SIGKILL)
    wait_until(lambda: not Path(f"/proc/{clock}").exists(), BOUND_S)
    assert rack("step", rack_name).returncode == 1


def test_options_that_contradict_are_usage_errors() -> None:
    done = rack("step", "any", "--ticks", "1", "--until", "counter")
    assert done.returncode == 2
    assert "--ticks counts ticks, but N and --until count cycles" in done.stderr


def test_real_time_cannot_be_stepped(tmp_path: Path) -> None:
    path = tmp_path / "counting.toml"
    path.write_text(counting(tmp_path).replace('mode = "lockstep"', 'mode = "realtime"'))
    refusal = read_refusal(rack("run", path, "--no-record", "--step"))
    assert refusal == "--step: real time cannot be held between two ticks; add --lockstep"
