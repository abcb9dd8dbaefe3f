"""Tests `rack inject` and `rack estop` on a running rack, and their refusals."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator

import pytest

from rack.backplane.fault_table import FaultTable, Stage
from rack.backplane.lines import UtilityLines
from rack.backplane.segment import Segment
from rack.backplane.words import Demand, System
from rack.boards.errors import ConfigError
from rack.boards.faults.kind import KINDS
from rack.tools.faults.live import LiveRack
from tests.boards.fault_racks import DRIVEN
from tests.processes import wait_until
from tests.tools.command_line import rack, read_answer, read_refusal
from tests.tools.held_racks import running_rack

TASKS = "wave, wave.planner, watch, driven, clock"


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Name of a real-time rack that runs until it is stopped."""
    path = tmp_path_factory.mktemp("rack") / "waves.toml"
    path.write_text(DRIVEN)
    # A machine that is busy must not use the restarts up.
    words = ("--set=clock.mode=realtime", "--set=supervision.restarts=1000")
    with running_rack(path, f"test-inject-{os.getpid()}", *words) as name:
        yield name
        assert rack("stop", name).returncode == 0


@pytest.mark.slow
def test_a_fault_begins_at_the_next_tick_and_says_which(running: str) -> None:
    segment = Segment.attach(running)
    before = segment.words[System.TICK]
    answer = read_answer("inject", running, "wave", "kill")
    assert before < answer["begins"] <= segment.words[System.TICK]
    assert (answer["kind"], answer["board"]) == ("kill", "wave")
    # It comes back, for the next test.
    entry = FaultTable(segment).entries[answer["fault"]]
    wait_until(lambda: entry.count and UtilityLines(segment).reset_obstacles == [])


@pytest.mark.slow
def test_waiting_is_for_the_end_of_a_fault(running: str) -> None:
    words = ("watch", "mute", "--cycles", "5", "--mailbox", "watch.status", "--wait")
    done = rack("inject", running, *words)
    assert done.returncode == 0
    told = re.match(r"mute of watch \(watch.status\): ticks (\d+) to (\d+),", done.stdout)
    assert told is not None
    assert int(told[2]) - int(told[1]) == 5 * 8 - 1


@pytest.mark.slow
def test_a_fault_can_wait_for_a_tick_and_for_a_condition(running: str) -> None:
    tick = Segment.attach(running).words[System.TICK] + 2000
    drop = ("inject", running, "wave", "drop", "--for", "5ms")
    answer = read_answer(*drop, "--tick", tick)
    # Later only by the ticks that a busy clock leaves out.
    assert answer["begins"] >= tick
    assert rack(*drop, "--when", "watch.status.state == executing").returncode == 0


@pytest.mark.slow
def test_a_fault_with_a_condition_is_armed_and_can_be_withdrawn(running: str) -> None:
    waits = "watch.status.state == error"
    answer = read_answer("inject", running, "watch", "mute", "--when", waits)
    number = answer["fault"]
    assert (answer["stage"], answer["waits_for"]) == ("waiting", waits)
    withdraw = f"to withdraw it: rack inject {running} --withdraw {number}"
    assert answer["message"] == f"mute of watch: armed, waits for {waits}; {withdraw}"
    entry = FaultTable(Segment.attach(running)).entries[number]
    assert rack("inject", running, "--withdraw", number).stdout == "mute of watch: withdrawn\n"
    assert entry.stage == Stage.FREE
    again = read_refusal(rack("inject", running, "--withdraw", number))
    assert again.startswith(f"fault {number} is not waiting; waiting: ")


@pytest.mark.slow
def test_the_faults_of_a_rack_are_listed(running: str) -> None:
    rack("inject", running, "wave", "babble", "--for", "20ms", "writes=5")
    listed = read_answer("inject", running, "--list")
    assert listed[-1]["text"] == "babble of wave (writes 5)"
    assert listed[-1]["stage"] in ("active", "over")
    words = rack("inject", running, "--list").stdout.split()
    # The columns of a table fold, so words of one cell may be lines apart.
    assert {"babble", "wave", "(writes", "5)"} <= set(words)


REFUSED = {
    "wve kill": f'board = "wve": no such task; tasks: {TASKS}',
    "wave kil": f'kind = "kil": no such kind; kinds: {", ".join(kind.name for kind in KINDS)}',
    "wave drop size=1": "size = 1: drop has no such parameter; parameters: probability",
    "wave drop probability": "'probability': a parameter must be key=value, as in size=0.05",
    "wave kill --timeout 1": "--timeout needs --wait; give both, or neither",
    "wave": "RACK, BOARD and KIND are needed, as in: rack inject nasrem servo kill; or --list",
}


@pytest.mark.slow
@pytest.mark.parametrize(("words", "line"), REFUSED.items(), ids=REFUSED)
def test_an_impossible_fault_is_refused_with_valid_values(
    running: str, words: str, line: str
) -> None:
    assert read_refusal(rack("inject", running, *words.split())).startswith(line)


IMPOSSIBLE: list[tuple[str, dict[str, str], str]] = [
    ("drop", {"probability": "2"}, "probability = 2: out of range; valid: 0.001 to 1; "),
    ("mute", {"for": "1h"}, 'for = "1h": should be a time, as in "0.5s", "20ms" or 0.5; '),
    (
        "mute",
        {"mailbox": "sea"},
        "mailbox = \"sea\": 'wave' does not write it; it writes: wave.sta",
    ),
    ("kill", {"tick": "0"}, "tick = 0: has passed; the rack is at tick "),
    ("kill", {"when": "sea"}, 'when = "sea": must be mailbox.field == value, as in "elemental_mo'),
    ("self-test", {}, 'kind = "self-test": a running rack has passed its self-tests; give it in'),
    ("hog", {}, "for: missing; a hog must have an end: --for or --cycles"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "keys", "line"), IMPOSSIBLE)
def test_a_fault_that_does_not_fit_the_rack_is_not_added(
    running: str, kind: str, keys: dict[str, str], line: str
) -> None:
    segment = Segment.attach(running)
    injected = segment.words[System.INJECTED]
    with pytest.raises(ConfigError) as error:
        LiveRack(segment).inject_fault({"board": "wave", "kind": kind, **keys}, wait=False)
    assert str(error.value).startswith(line)
    assert segment.words[System.INJECTED] == injected


@pytest.mark.slow
def test_the_emergency_stop_is_latched_until_it_is_reset(running: str) -> None:
    words = Segment.attach(running).words
    done = rack("estop", running)
    assert (done.returncode, words[System.EMERGENCY_STOP]) == (0, 1)
    assert words[System.DEMAND] == Demand.BRAKE
    assert "emergency stop latched at tick" in done.stdout
    # The first line is folded where a machine that is late makes it longer.
    heading = rack("status", running).stdout.partition("\n\n")[0]
    assert "EMERGENCY STOP arm: brake" in " ".join(heading.split())
    words[System.ACFAIL] = 1
    refused = rack("estop", running, "--reset")
    assert (refused.returncode, refused.stderr) == (1, "the emergency stop stays latched: ACFAIL\n")
    assert words[System.EMERGENCY_STOP] == 1
    words[System.ACFAIL] = 0
    reset = read_answer("estop", running, "--reset")
    assert (reset["emergency_stop"], words[System.EMERGENCY_STOP]) == (False, 0)
    assert words[System.DEMAND] == Demand.NONE


def test_the_list_has_every_kind_with_its_means_bound_and_parameters() -> None:
    shown = rack("inject", "--list").stdout
    lines = {tuple(line.split()[:2]): line for line in shown.splitlines()}
    words = shown.split()
    for kind in KINDS:
        # The columns of a table fold, so words of one cell may be lines apart.
        at = words.index(kind.name)
        row = words[at : at + 40]
        assert set(f"{kind.means} {kind.bound}".split()) <= set(row), kind.name
        assert all((kind.name, parameter.name) in lines for parameter in kind.parameters)
    listed = read_answer("inject", "--list")
    assert [kind["name"] for kind in listed] == [kind.name for kind in KINDS]
