"""The rack brown as two racks on a network: one command launches both; modifications travel from
the general machine to the servo rack; what this one does while the cable is out."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.segment import SHM_FOLDER
from rack.boards.config import CONFIGS, load
from rack.levels.operator import Answer
from tests import golden
from tests.boards.lan.racks import ended, running, watch
from tests.conftest import EXHAUSTIVE
from tests.machine import needs_lab
from tests.network_lab import Lab
from tests.processes import RACK, run_to_end, wait_until
from tests.snapshots import Snapshots
from tests.test_cell_page import ONE_MACHINE, OWN_MEMORY
from tests.tools.command_line import ROOT, rack
from tests.warm import Popen, run_command

SNAPSHOTS = Snapshots(__file__)
LINK_OUT = """
[[fault]]
kind = "mute"
board = "lan"
mailbox = "lan.reference"
at = 1.5
for = 0.5
"""
"""Twenty-five references of the general machine do not come."""
SECONDS = 2.4
LAST = 2399
"""Simulated time of both racks together, and its last tick."""
LOSS = ("peer_lost", "demand")
"""Codes of the events of a loss, and of the stop that it demands."""
REFUSED = "it ran in real time on a network, but only lockstep runs can be repeated"
HELD = "no reference from 'lan': held after 5 extrapolated"
MOVING_RAD_S = 0.05
NEAR, FAR = 7447, 7448
"""Ports of the relay and of the servo rack, on a machine of its own."""
MOST_S = 120.0
"""Longest time for the launch of both racks, or for a whole run, on a busy machine."""


def configs(name: str, folder: Path, more: str = "") -> list[Path]:
    """Write the configs of servo rack, with `more`, and general machine, under names of their
    own."""
    found = []
    for file in (CONFIGS / "brown" / "servo.toml", CONFIGS / "brown" / "brown.toml"):
        text = file.read_text().replace('"../', '"')
        text = text.replace("peer_brown", f"peer_{name.replace('-', '_')}")
        found.append(folder / file.name)
        found[-1].write_text(re.sub(r"\bbrown\b(?!\.toml)", name, text))
    found[0].write_text(found[0].read_text() + more)
    return found


class Ran(NamedTuple):
    """A run of both racks: digests of servo rack and general machine, and mailboxes."""

    digests: list[str]
    boxes: dict[str, np.ndarray]
    answers: list[tuple[int, int, int]]
    """Of the general machine to its operator: tick, command, answer."""

    def values(self, mailbox: str, field: str, first: int, last: int) -> np.ndarray:
        """Return a field of the servo rack's messages from one tick to another."""
        rows = self.boxes[mailbox]
        return np.asarray(rows["message"][field][(rows["tick"] >= first) & (rows["tick"] <= last)])

    def speed(self, first: int, last: int) -> float:
        """Return the greatest speed of a joint wanted from one tick to another, rad/s."""
        return float(np.abs(self.values("arm.status", "target_velocity", first, last)).max())


def ran(name: str, folder: Path) -> Ran:
    racks = [load(path, ["clock.mode=lockstep"]) for path in configs(name, folder, LINK_OUT)]
    with running(racks) as (servo, general):
        for rack in (servo, general):
            rack.start(SECONDS)
        watch([servo, general])
        found = [ended(servo), ended(general)]
        names = "arm.status", "shoulder.status", "supervisor.status", "supervisor.command"
        boxes = {box: MailboxRing(servo.segment, box).read_new_rows().rows for box in names}
        rows = MailboxRing(general.segment, "modifications.status").read_new_rows().rows
    assert [one.outcome.cause for one in found] == ["time over"] * 2, [one.texts for one in found]
    shown = zip(rows["tick"], rows["message"]["order"], rows["message"]["answer"], strict=True)
    answers = [(int(tick), int(order), int(answer)) for tick, order, answer in shown]
    return Ran([one.outcome.digest for one in found], boxes, answers)


@pytest.fixture(scope="module")
def name() -> str:
    """The name of both runs: digests contain it."""
    return "test-brown-network"


@pytest.fixture(scope="module")
def run(name: str, tmp_path_factory: pytest.TempPathFactory) -> Ran:
    return ran(name, tmp_path_factory.mktemp("brown"))


@pytest.mark.thorough
def test_a_modification_of_the_general_machine_is_put_in_over_the_network_without_a_step(
    run: Ran,
) -> None:
    # Commanded at 1.2 s; on each of its ways it waits for a cycle of 20 ms and two of 10 ms.
    reasons = run.values("shoulder.status", "reason", 1200, 1300)
    first = int(np.argmax(reasons == b"modified by pd"))
    assert 0 < first <= 60
    assert run.speed(1200, 1300) > MOVING_RAD_S
    torque = run.values("shoulder.status", "torque", 1200 + first - 1, 1200 + first)
    np.testing.assert_allclose(torque[1], torque[0], atol=1e-12)
    # The general machine's ticks are of 5 ms.
    begun, done = (
        next(5 * tick for tick, order, answer in run.answers if (order, answer) == (1, wanted))
        for wanted in (Answer.TAKEN, Answer.DONE)
    )
    assert begun < 1200 + first < done <= 1300, "done is what the boards have answered"


@pytest.mark.slow
def test_while_the_link_is_out_the_servo_rack_extrapolates_holds_and_then_goes_on(
    run: Ran,
) -> None:
    status = run.boxes["supervisor.status"]
    held = status["tick"][status["message"]["reason"] == HELD.encode()]
    # The last reference before the fault, five made up, and the time of the link.
    assert 1600 < held[0] < 1700
    after = held[-1]
    assert run.speed(1500, 1500) > MOVING_RAD_S
    assert run.speed(after, after) < 1e-3, "it rests"
    assert run.speed(after, LAST) > MOVING_RAD_S, "it moves again"
    assert not run.values("arm.status", "braked", 1200, LAST).any()
    assert run.values("shoulder.status", "reason", 2000, 2000).tolist() == [b"modified by pd"]


@pytest.mark.thorough
def test_both_racks_repeat_bit_for_bit(run: Ran, name: str, tmp_path: Path) -> None:
    assert ran(name, tmp_path).digests == run.digests


@pytest.mark.thorough
@needs_lab
def test_one_command_runs_both_to_the_end_of_the_program(tmp_path: Path) -> None:
    command = [*RACK, "run", "brown", "--lockstep", "--no-record", "--json"]
    done = run_to_end(
        [*ONE_MACHINE, *OWN_MEMORY, "sh", "-c", 'ip link set lo up; exec "$@"', "sh", *command],
        MOST_S,
        cwd=tmp_path,
    )
    assert (done.returncode, done.stderr) == (0, "")
    general = json.loads(done.stdout)
    (servo,) = general["others"]
    assert (general["outcome"]["cause"], servo["cause"]) == ("task done", "task done")
    if golden.machine()["libm"] == golden.read()["machine"]["libm"]:
        digests = {report["rack"]: report["digest"] for report in (general, servo)}
        SNAPSHOTS.check("lockstep", digests)


class Launched:
    """`rack run` of both racks in lockstep, until the general machine runs."""

    def __init__(self, folder: Path, name: str, *words: str) -> None:
        _, general = configs(name, folder)
        command = [*RACK, "run", str(general), "--lockstep", "--no-record", *words]
        self.name = name
        self.process = Popen(
            command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def await_tick(self) -> None:
        """Wait until the servo rack is moving on."""
        names = [f"nasrem-rack.{self.name}{rack}" for rack in ("", "-servo")]
        wait_until(lambda: all((SHM_FOLDER / one).exists() for one in names), MOST_S)
        assert self.process.stderr is not None
        for line in self.process.stderr:
            if "tick" in line and "command" in line:
                return
        raise AssertionError(self.process.communicate())

    def await_end(self) -> tuple[int, str]:
        """Return its exit status and last words, once nothing of both racks is left."""
        _, said = self.process.communicate(timeout=MOST_S)
        assert not [path.name for path in SHM_FOLDER.glob(f"*{self.name}*")]
        return self.process.returncode, said

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Kill both, should they still run."""
        self.process.kill()
        self.process.communicate()


@pytest.mark.thorough
def test_an_interrupt_ends_both_and_leaves_nothing(rack_name: str, tmp_path: Path) -> None:
    with Launched(tmp_path, rack_name) as both:
        both.await_tick()
        both.process.send_signal(signal.SIGINT)
        assert both.await_end()[0] == 128 + signal.SIGINT


@pytest.mark.thorough
def test_a_rack_that_cannot_be_launched_ends_the_other_with_status_1(
    rack_name: str, tmp_path: Path
) -> None:
    absent = 'adapter.lan.launch=["none/none.toml"]'
    with Launched(tmp_path, rack_name, "--set", absent) as both:
        status, said = both.await_end()
    assert status == 1
    assert 'config = "none/none.toml": no such file' in said
    assert " failed: stopped: " in said.splitlines()[-1]
    assert '; none/none.toml: config = "none/none.toml": no such file' in said.splitlines()[-1]


def reported(folder: Path, *words: str | Path) -> tuple[dict[str, Any], str]:
    """Run a rack in a folder; return its report and stderr."""
    command = [*RACK, "run", *words, "--json"]
    done = run_command(command, MOST_S, cwd=folder, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), done.stderr


def repeated(run: Path, out: Path) -> tuple[str, str]:
    """Continue a run from 1.3 s, in the middle of a modification, to 3 s; return digest and
    stderr."""
    report, said = reported(run, "--from", f"{run}@1.3", "--seconds", "3", "--out", out)
    return report["digest"], said


def found_lost(run: Path) -> list[tuple[int, str]]:
    """Return when a run found another rack lost, and when the arm was to stop, with the texts;
    they come from two processes."""
    events = map(json.loads, (run / "events.jsonl").read_text().splitlines())
    return sorted((event["tick"], event["text"]) for event in events if event.get("code") in LOSS)


@pytest.mark.thorough
def test_a_run_of_either_rack_is_continued_without_the_other(
    rack_name: str, tmp_path: Path
) -> None:
    general = configs(rack_name, tmp_path, LINK_OUT)[1]
    report, _ = reported(tmp_path, general, "--lockstep", "--seconds", "3")
    for own, other in ((report, f"{rack_name}-servo"), (report["others"][0], rack_name)):
        digest, said = repeated(tmp_path / own["folder"], tmp_path / f"without {other}")
        assert f"not started: '{other}'; their recorded messages are replayed" in said
        assert digest == own["digest"]
        assert "are not as recorded" not in said


@pytest.mark.thorough
def test_a_rack_that_was_lost_is_lost_again(rack_name: str, tmp_path: Path) -> None:
    servo, general = configs(rack_name, tmp_path)
    alone = [*RACK, "run", general, "--lockstep", "--share", "--no-record", "--seconds", "1.6"]
    other = Popen([*alone, "--set", "adapter.lan.launch=[]"], stdout=subprocess.DEVNULL)
    try:
        run = tmp_path / "run"
        words = ["--lockstep", "--share", "--seconds", "3", "--json", "--out", run]
        command = [*RACK, "run", servo, *words, "--set", 'adapter.lan.on_peer_loss="stop"']
        done = run_command(command, MOST_S, text=True)
    finally:
        other.kill()
        other.wait()
    found = json.loads(done.stdout)
    assert found["outcome"]["ticks"] == 3000, done.stderr
    assert found["outcome"]["reason"] == "the other rack is lost"
    assert repeated(run, tmp_path / "again")[0] == found["digest"]
    lost = [found_lost(folder) for folder in (run, tmp_path / "again")]
    assert len(lost[0]) == len(LOSS)
    assert lost[1] == lost[0]


def find_responses(report: dict[str, Any], direction: str, end: str) -> list[dict[str, Any]]:
    """Return the measured responses in a direction between levels, the last of which is `end`."""
    response = report["system_response"]
    found = [one[direction] for one in (response, *response["others"])]
    return [one for one in found if one["levels"] and one["levels"][-1] == end]


@pytest.mark.thorough
def test_in_lockstep_the_longest_response_across_racks_is_the_predicted_one(
    rack_name: str, tmp_path: Path
) -> None:
    general = configs(rack_name, tmp_path)[1]
    upper, _ = reported(tmp_path, general, "--lockstep", "--seconds", "1.2", "--share")
    lower = json.loads((tmp_path / upper["others"][0]["folder"] / "report.json").read_text())
    assert not [text for one in (upper, lower) for text in one["unjudged"] if "response" in text]
    (status,) = find_responses(upper, "status", f"{rack_name}/planning")
    (order,) = find_responses(lower, "command", f"{rack_name}-servo/arm")
    assert status["levels"][0] == f"{rack_name}-servo/arm"
    assert order["levels"][0] == f"{rack_name}/trajectory"
    found = rack(
        "analyze", tmp_path / upper["folder"], tmp_path / upper["others"][0]["folder"], "--json"
    )
    across = [one for one in json.loads(found.stdout)["across"] if one["count"]]
    assert found.returncode == 0
    for response in (status, order, *across):
        assert response["measured_ms"]["max"] == pytest.approx(response["bound_ms"])
        assert response["holds"]
    ends = {(one["levels"][0], one["levels"][-1]): one["parts"] for one in across}
    # The wait for the next exchange, and what the racks and the link take in lockstep.
    assert ends[f"{rack_name}-servo/arm", f"{rack_name}/planning"] == {
        "waiting for new information": 19.0,
        f"{rack_name}-servo": 2.0,
        f"link to {rack_name}": 2.0,
        rack_name: 220.0,
    }


@pytest.mark.thorough
@pytest.mark.alone
@needs_lab
@pytest.mark.parametrize("delay_ms", [0, 5, 20, 50] if EXHAUSTIVE else [5, 50])
def test_on_a_slow_network_each_long_response_has_a_cause(
    delay_ms: int, rack_name: str, tmp_path: Path
) -> None:
    servo, general = configs(rack_name, tmp_path)
    relay = [sys.executable, "-m", "tests.slow_link", str(NEAR), str(FAR), str(delay_ms)]
    shared = ["--share", "--json", "--seconds", "6", "--set", "adapter.lan.insecure=true"]
    shared += ["--set", "adapter.lan.estop_from=[]"]
    alone = ["--set", "adapter.lan.launch=[]", "--set", 'adapter.lan.partners=["servo.toml"]']
    with Lab(2) as lab:
        listening = ["--set", f'adapter.lan.listen=["tcp/127.0.0.1:{FAR}"]']
        connecting = ["--set", f'adapter.lan.connect=["tcp/{lab.address(0)}:{NEAR}"]']
        runs = (
            [*RACK, "run", str(servo), *shared, *listening, "--out", "lower"],
            [*RACK, "run", str(general), *shared, *connecting, *alone, "--out", "upper"],
        )
        lab.popen(0, relay, cwd=ROOT)
        started = [
            lab.popen(machine, run, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
            for machine, run in enumerate(runs)
        ]
        lower, upper = (json.loads(one.communicate(timeout=MOST_S)[0]) for one in started)
    (status,) = find_responses(upper, "status", f"{rack_name}/planning")
    (order,) = find_responses(lower, "command", f"{rack_name}-servo/arm")
    found = rack("analyze", tmp_path / "upper", tmp_path / "lower", "--json")
    across = [one for one in json.loads(found.stdout)["across"] if one["count"]]
    assert {one["direction"] for one in across} == {"command", "status"}
    # A response of one run begins too early by up to the uncertainty of the clocks.
    for response in (status, order, *across):
        assert response["measured_ms"]["max"] > 0.0
        assert all(one["delayed_by"] or one["network"] for one in response["beyond"])
    assert found.returncode == any(one["beyond"] for one in across)
    causes = [cause for one in across for excess in one["beyond"] for cause in excess["network"]]
    # The budget of the link is 20 ms.
    if delay_ms > 20:
        assert not any(one["holds"] for one in across)
        assert any(cause.startswith("the link took ") for cause in causes)
