"""Tests `rack command` on running racks: giving a command, waiting for the reply, and refusals."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

from rack.backplane.operator_table import OperatorTable
from rack.backplane.segment import Segment, list_racks
from rack.backplane.words import System
from rack.tools.monitor.desk import LevelCommander
from rack.tools.scripting.attached import AttachedRack
from tests.boards.commanded_racks import COMMANDED, commands
from tests.processes import wait_until
from tests.tools.command_line import BOUND_S, rack, read_answer, read_refusal, started
from tests.tools.held_racks import running_rack

pytestmark = pytest.mark.slow


def homing_rack(path: Path, name: str, *words: str) -> AbstractContextManager[str]:
    """Run a rack that takes commands until the end of the context."""
    path.write_text(COMMANDED.replace("commanded_levels:Lower", "commanded_levels:Homing"))
    return running_rack(path, name, *words)


@pytest.fixture(scope="module", params=["realtime", "lockstep"])
def running(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[str]:
    """Name of a rack that runs until it is stopped."""
    mode, path = request.param, tmp_path_factory.mktemp("rack") / "told.toml"
    # An operator is silent after a second of simulated time: a process of a busy machine must not
    # be.
    slow = ("--set=clock.speed=0.25",) if mode == "realtime" else ()
    words = (f"--set=clock.mode={mode}", *slow)
    with homing_rack(path, f"test-command-{mode}-{os.getpid()}", *words) as name:
        yield name


def test_a_command_is_given_and_taken_up(running: str) -> None:
    answer = read_answer("command", running, "upper", "hold")
    assert (answer["level"], answer["text"], answer["worked"]) == ("upper", "hold", True)
    assert answer["fate"] in ("taken", "done")
    # Read at the first release after its tick, if none was skipped.
    assert answer["given"] < answer["taken_up"]
    assert answer["taken_up"] % 8 == 0
    again = rack("command", running, "upper", "resume")
    assert again.returncode == 0
    (line,) = again.stdout.splitlines()
    assert line.startswith(f"command {answer['serial'] + 1} to 'upper', resume: given at tick ")


def test_waiting_lasts_until_the_command_is_done_and_tells_how_to_end_it(running: str) -> None:
    answer = read_answer("command", running, "upper", "hold", "--wait")
    assert answer["fate"] == "done"
    # The level below has answered: two cycles later.
    assert answer["given"] < answer["taken_up"] < answer["done"]
    held = rack("command", running, "upper", "hold").stdout.splitlines()
    assert held[1:] == [f"in force until: rack command {running} upper resume"]
    refused = rack("command", running, "upper", "goto", "home")
    assert refused.returncode == 1
    assert refused.stdout.rstrip().endswith(": the way home is closed")
    assert rack("command", running, "upper", "resume").returncode == 0
    rows = {row["level"]: row for row in read_answer("command", running, "--list")}
    assert rows["upper"] == {"level": "upper", "in_force": "", "takes": "hold, resume, goto home"}
    assert rows["lower"]["takes"] == "hold, resume, modify twice on|off, set by, goto home"


@contextmanager
def waiting(name: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A process that waits for the end of its command, and the serial of the command."""
    words = Segment.attach(name).words
    given = words[System.COMMANDED]
    with started("command", name, "lower", "goto", "home", "--wait", "--json") as process:
        wait_until(lambda: words[System.COMMANDED] > given)
        yield process, given + 1


def test_a_wait_continues_while_another_operator_sets_a_parameter(running: str) -> None:
    with waiting(running) as (process, serial):
        assert rack("set", running, "board.lower.params.by=2").returncode == 0
        assert rack("command", running, "lower", "modify", "twice", "off").returncode == 0
        assert process.poll() is None
        assert rack("set", running, "board.lower.params.by=9").returncode == 0
        answer = json.loads(process.communicate(timeout=BOUND_S)[0])
    assert (process.returncode, answer["serial"], answer["fate"]) == (0, serial, "done")
    assert rack("set", running, "board.lower.params.by=1").returncode == 0
    assert rack("command", running, "lower", "resume").returncode == 0


def test_a_wait_ends_when_another_command_supersedes_its_command(running: str) -> None:
    with waiting(running) as (process, serial):
        assert rack("command", running, "lower", "resume").returncode == 0
        answer = json.loads(process.communicate(timeout=BOUND_S)[0])
    assert (answer["serial"], answer["fate"]) == (serial, "superseded")


@contextmanager
def leasing(name: str) -> Iterator[subprocess.Popen[str]]:
    """A process that has leased a hold of the upper level."""
    with started("command", name, "upper", "hold", "--lease") as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("command ")
        yield process


@pytest.mark.parametrize("gone", [signal.SIGKILL, signal.SIGSTOP])
def test_a_level_holds_when_the_operator_of_a_lease_has_gone(
    running: str, gone: signal.Signals
) -> None:
    segment = Segment.attach(running)
    with AttachedRack(running) as live:
        with leasing(running) as process:
            modes = {row.task: row.mode for row in live.status().tasks}
            given = segment.words[System.COMMANDED]
            process.send_signal(gone)
            if gone == signal.SIGSTOP and segment.words[System.LOCKSTEP]:
                # A tick of lockstep has no length: silence means nothing there.
                until = segment.words[System.TICK] + 1000
                wait_until(lambda: segment.words[System.TICK] > until)
                assert OperatorTable(segment).list_leased()
                process.kill()
            event = live.wait_for("operator_gone", BOUND_S)
        assert modes == {"upper": "operator", "lower": "automatic"}
        text = f"hold: its operator is gone: hold (command {given + 1})"
        assert (event.board, event.text) == ("upper", text)
        assert segment.words[System.COMMANDED] == given + 1
    assert rack("command", running, "upper", "resume").returncode == 0


def test_a_lease_ends_when_another_command_supersedes_it(running: str) -> None:
    segment = Segment.attach(running)
    with leasing(running) as process:
        # Refused, so the hold is still in force; then taken.
        assert rack("command", running, "upper", "goto", "home").returncode == 1
        assert process.poll() is None
        assert rack("command", running, "upper", "resume").returncode == 0
        assert process.wait(BOUND_S) == 0
    assert not OperatorTable(segment).list_leased()
    assert LevelCommander(segment).list_highest_levels("hold") == []


def test_a_paused_rack_continues_from_its_tick(running: str) -> None:
    words = Segment.attach(running).words
    paused = read_answer("pause", running)
    assert paused["paused"] is True
    if words[System.LOCKSTEP]:
        assert (paused["levels"], words[System.HELD]) == ([], paused["tick"] + 1)
        again = rack("pause", running).stdout
        assert again.startswith(f"rack '{running}': held before tick {paused['tick']}; ")
    else:
        assert paused["levels"] == ["upper"]
        assert LevelCommander(Segment.attach(running)).list_highest_levels("hold") == ["upper"]
        tick = words[System.TICK]
        wait_until(lambda: words[System.TICK] > tick)
    done = rack("resume", running)
    assert (done.returncode, done.stdout) == (0, f"rack '{running}' continues\n")
    tick = words[System.TICK]
    wait_until(lambda: words[System.TICK] > tick)
    assert read_refusal(rack("resume", running), status=1) == f"rack '{running}' is not paused"


def test_a_live_parameter_is_set_and_others_are_refused(running: str) -> None:
    answer = read_answer("set", running, "board.lower.params.by=2")
    assert (answer["text"], answer["fate"]) == ("set by=2", "done")
    params = "board.lower.params"
    for setting, line in {
        f"{params}.bye=1": f"{params}.bye = 1: not a live parameter; live parameters: by",
        f"{params}.label='x'": f'{params}.label = "x": not a live parameter; live parameters: by',
        f"{params}.by": 'name = "by": must be key=value, as in bandwidth=80',
        "clock.speed=2": f"clock.speed=2: not a live parameter; valid keys: {params}.by",
    }.items():
        assert read_refusal(rack("set", running, setting)).endswith(line)
    refused = rack("set", running, f"{params}.by=0")
    assert refused.returncode == 1
    assert "should be greater than or equal to 1; keys: by" in refused.stdout
    assert rack("set", running, "board.lower.params.by=1").returncode == 0


@pytest.mark.thorough
def test_a_parameter_set_on_a_held_rack_repeats_with_a_command_of_its_config(
    commanded: Path, rack_name: str
) -> None:
    run = ("run", commanded, "--no-record", "--seconds", "0.4", "--set", f"name={rack_name}")
    with started(*run, "--json", "--step") as held:
        wait_until(
            lambda: rack_name in list_racks() and Segment.attach(rack_name).words[System.HELD]
        )
        given = rack("set", rack_name, "board.lower.params.by=3", "--tick", "101")
        assert given.returncode == 0
        assert " set by=3: waits: the rack is held before" in given.stdout
        assert rack("resume", rack_name).returncode == 0
        answer, _ = held.communicate(timeout=BOUND_S)
    command = commands("level='lower', what='set', name='by=3', tick=101")
    repeated, plain = read_answer(*run, "--set", command), read_answer(*run)
    assert json.loads(answer)["digest"] == repeated["digest"] != plain["digest"]


REFUSED = {
    "upper resume --lease": "--lease: 'upper', resume: must be one of hold, ",
    "upper hold --lease --wait": "--lease and --wait: a lease waits anyway",
    "uper hold": 'level = "uper": no level of this name takes commands; levels that do: up',
    "upper hold --timeout 1": "--timeout needs --wait; give both, or neither",
    "upper": "LEVEL and WHAT are needed, as in: rack command ",
    "upper halt": "'enable', 'disable', 'reset' or 'release'",
    "lower setpoint joints=1": "'lower' does not take setpoint; it takes: hold, resume",
    "upper goto": "goal: missing; goto of 'upper' takes one of: home",
    "upper goto hom": "'hom': not a goal; valid goals: home, joints=..., position=...",
    "upper goto joints=1,x": "'joints=1,x': 'x' is not a number; numbers are separated by",
    "upper goto joints=1 joints=2": "'joints=2': joints is given twice",
    "upper hold --tick 0": "tick = 0: has passed; the rack is at tick ",
}


@pytest.mark.parametrize("running", ["lockstep"], indirect=True)
@pytest.mark.parametrize(("words", "reason"), REFUSED.items(), ids=REFUSED)
def test_bad_usage_is_one_line_and_status_2(running: str, words: str, reason: str) -> None:
    assert reason in read_refusal(rack("command", running, *words.split()))


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_a_client_that_ends_while_it_waits_leaves_no_command_behind(
    running: str, end: signal.Signals
) -> None:
    table = OperatorTable(Segment.attach(running))
    with started("command", running, "upper", "hold", "--tick", 10**9) as process:
        wait_until(table.list_waiting)
        process.send_signal(end)
        process.communicate(timeout=BOUND_S)
        assert process.returncode == (-end if end == signal.SIGKILL else 128 + end)
    assert table.list_waiting() == []
