"""`rack step`: a rack in lockstep holds between ticks, goes on by cycles, and ends when it is
stopped meanwhile."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from rack.backplane.segment import Segment
from rack.backplane.words import System
from tests.boards.table_racks import counting
from tests.processes import RACK, wait_until
from tests.tools.command_line import BOUND_S, ROOT, rack


@pytest.fixture
def held(rack_name: str, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A rack that counts, held before tick 0."""
    path = tmp_path / "counting.toml"
    path.write_text(counting(tmp_path))
    command = [
        *RACK,
        "run",
        str(path),
        "--no-record",
        "--lockstep",
        "--step",
        "--set",
        f"name={rack_name}",
    ]
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    wait_until(lambda: is_held(rack_name), BOUND_S)
    yield process
    process.kill()
    process.communicate()
    rack("clean")


def is_held(name: str) -> bool:
    """Return whether a rack is there and held."""
    try:
        return bool(Segment.attach(name).words[System.HELD])
    except Exception:
        return False


def stepped(name: str, *options: str) -> tuple[int, dict[str, str]]:
    """Step a rack; return the tick before which it holds, and the row of its counter."""
    done = rack("step", name, *options, "--json")
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    return answer["tick"], next(level for level in answer["levels"] if level["level"] == "counter")


@pytest.mark.slow
def test_a_held_rack_goes_on_by_cycles_and_ticks(
    held: subprocess.Popen[str], rack_name: str
) -> None:
    assert [stepped(rack_name)[0] for _ in range(3)] == [1, 9, 17]
    assert stepped(rack_name, "--ticks", "3")[0] == 20
    tick, level = stepped(rack_name, "--until", "counter")
    assert (tick, level["row"]) == (21, "row 3 'count up', now in 'up', table saw")
    assert stepped(rack_name, "--cycles", "4", "--until", "counter")[0] == 37
    tick, level = stepped(rack_name, "--until", "counter")
    assert (tick, level["row"]) == (41, "row 4 'turn', now in 'down', table saw")
    given = rack("command", rack_name, "counter", "table", "slow")
    assert (
        given.stdout
        == "command to 'counter', table slow: waits for the next step of the rack, which is held\n"
    )
    tick, level = stepped(rack_name, "--cycles", "2", "--until", "counter")
    assert (tick, level["row"]) == (49, "row 4 'rest', now in 'resting', table slow")
    text = rack("step", rack_name, "--ticks", "1").stdout
    assert f"{rack_name}: held before tick 50, 0.125 s" in text
    assert f"HELD: 'rack step {rack_name}' lets it go on" in rack("status", rack_name).stdout


@pytest.mark.slow
def test_a_rack_let_go_runs_is_held_again_and_ends_in_order(
    held: subprocess.Popen[str], rack_name: str
) -> None:
    assert rack("step", rack_name, "--run").stdout == f"rack '{rack_name}' runs on\n"
    words = Segment.attach(rack_name).words
    wait_until(lambda: words[System.TICK] > 100 and not words[System.HELD])
    first, _ = stepped(rack_name, "--ticks", "1")
    assert stepped(rack_name, "--ticks", "1")[0] == first + 1
    assert rack("stop", rack_name).returncode == 0
    assert held.wait(BOUND_S) == 1
    assert rack("step", rack_name).returncode == 1


@pytest.mark.slow
def test_a_held_rack_ends_with_its_launcher(held: subprocess.Popen[str], rack_name: str) -> None:
    clock = Segment.attach(rack_name).words[System.CLOCK_PID]
    os.kill(held.pid, signal.SIGKILL)
    wait_until(lambda: not Path(f"/proc/{clock}").exists(), BOUND_S)
    assert rack("step", rack_name).returncode == 1


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (
            ("--ticks", "1", "--until", "counter"),
            "--ticks counts ticks, --cycles and --until count cycles",
        ),
        (("--run", "--ticks", "1"), "--run lets the rack run on; leave out the steps"),
    ],
)
def test_options_that_contradict_are_usage_errors(options: tuple[str, ...], reason: str) -> None:
    done = rack("step", "any", *options)
    assert (done.returncode, reason in done.stderr) == (2, True)


def test_real_time_cannot_be_stepped(tmp_path: Path) -> None:
    path = tmp_path / "counting.toml"
    path.write_text(counting(tmp_path).replace('mode = "lockstep"', 'mode = "realtime"'))
    done = rack("run", path, "--no-record", "--step")
    assert (done.returncode, done.stderr) == (
        2,
        "--step: real time cannot be held between two ticks; add --lockstep\n",
    )
