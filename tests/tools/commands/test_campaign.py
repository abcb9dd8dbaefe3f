"""Tests small campaigns with few faults on real racks, and the mistakes that they must detect."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from rack.backplane.segment import SHM_FOLDER
from tests.processes import RACK, children_of, named, wait_until
from tests.tools.command_line import BOUND_S, ROOT, rack, read_refusal, started

pytestmark = pytest.mark.thorough

PROMPT_S = 15.0
"""A tenth of it is usual; a campaign that waited for its trials took 30 s and more."""
STALLING = """
import os
import time
from pathlib import Path

from two_levels import Upper


class Stalling(Upper):
    def self_test(self):
        folder = Path(os.environ["CAMPAIGN"])
        launched = folder / f"launched-{os.getppid()}"
        if launched.exists():
            (folder / f"stalls-{os.getpid()}").touch()
            time.sleep(600)
        launched.touch()
"""
"""Stalls every launch of a crate but the first: that of the faultless rack, which each worker runs
before its trials."""


LOCKSTEP = ("--lockstep", "--injections", "2", "--seed", "4", "--seconds", "9", "--json")


def test_a_killed_campaign_continues_and_detects_every_death_and_hang(
    small: Path, tmp_path: Path
) -> None:
    out = tmp_path / "campaign"
    options = (*LOCKSTEP, "--kinds", "kill,hang,self-test", "--out", str(out))
    trials = out / "trials"
    with started("campaign", small, *options, stdout=subprocess.DEVNULL, stderr=None):
        wait_until(lambda: len(list(trials.glob("0*.json"))) > 0, BOUND_S)
    there = {path.name: path.stat().st_mtime_ns for path in trials.glob("*.json")}
    done = rack("campaign", small, *options)
    report = json.loads(done.stdout)
    assert (done.returncode, done.stderr, report["shortfalls"]) == (0, "", [])
    # What was done is not done again.
    assert {name: (trials / name).stat().st_mtime_ns for name in there} == there
    summary = report["summary"]
    assert {summary[key] for key in ("injected", "detected", "within_bound", "recovered")} == {6}
    bounds = {kind: found["wilson"]["detected"] for kind, found in report["by_kind"].items()}
    assert bounds == {kind: [0.34238, 1.0] for kind in ("kill", "hang", "self-test")}
    assert {summary[key] for key in ("limits_violated", "left_behind", "unexplained")} == {0}
    ended = ("tasks_done", "verdicts_certain", "not_armed")
    assert sum(summary[key] for key in ended) == summary["trials"] >= 3
    assert json.loads((out / "campaign.json").read_text()) == report
    assert (out / "campaign.md").read_text().startswith(f"# Campaign on {small}, seed 4: passed")
    assert (out / "campaign.png").read_bytes().startswith(b"\x89PNG")
    assert len(list(trials.glob("0*.json"))) == summary["trials"]
    assert not list(out.glob("*.toml"))


@pytest.mark.parametrize("numbers", [(signal.SIGTERM,), (signal.SIGINT,) * 2])
def test_a_signal_ends_launching_trials_and_keeps_finished_ones(
    small: Path, write: Callable[[str, str], Path], tmp_path: Path, numbers: tuple[int, ...]
) -> None:
    write("stalling.py", STALLING)
    text = small.read_text().replace("python_path = [", f'python_path = ["{tmp_path}", ')
    small.write_text(text.replace("two_levels:Upper", "stalling:Stalling"))
    out = tmp_path / "campaign"
    before = semaphores_of_python()
    # Trials of the second kind launch a rack. Others continue from a snapshot, without a self-test.
    options = (*LOCKSTEP, "--kinds", "mute,self-test", "--out", str(out))
    process = subprocess.Popen(
        [*RACK, "campaign", str(small), *options],
        cwd=ROOT,
        env={**os.environ, "CAMPAIGN": str(out)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        wait_until(lambda: len(list(out.glob("stalls-*"))) >= len(os.sched_getaffinity(0)), BOUND_S)
        racks = [f"camp-{worker}x" for worker in children_of(process.pid)]
        finished = sorted((out / "trials").glob("*.json"))
        for number in numbers:
            process.send_signal(number)
        printed, said = process.communicate(timeout=PROMPT_S)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 128 + numbers[0], said
    assert finished[-1].name == "nominal.json"
    assert sorted((out / "trials").glob("*.json")) == finished
    # A slow machine has no time for the report within the bound of a signal.
    if len(numbers) == 1 and "no time for the report" not in said:
        report = json.loads(printed)
        assert (report["interrupted"], report["summary"]["trials"]) == (True, len(finished) - 1)
        assert json.loads((out / "campaign.json").read_text()) == report
    assert racks
    wait_until(lambda: not [name for name in racks if named(name)])
    left = [path.name for path in SHM_FOLDER.iterdir()]
    assert not [name for name in left if any(rack in name for rack in racks)]
    # Those of tests beside this one go with them.
    wait_until(lambda: semaphores_of_python() <= before, BOUND_S)


def semaphores_of_python() -> set[str]:
    return {path.name for path in SHM_FOLDER.glob("sem.mp-*")}


def test_boards_killed_from_outside_are_detected_and_restarted(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "campaign"
    options = ("--lockstep", "--kills", "3", "--seconds", "12", "--out", out, "--json")
    summary = json.loads(rack("campaign", small, *options).stdout)["summary"]
    # How fast the Rack hears of a death depends on how busy this machine is.
    assert summary["injected"] == summary["detected"] == summary["recovered"] == 3
    assert (summary["left_behind"], summary["unexplained"]) == (0, 0)
    assert summary["tasks_done"] == summary["trials"]


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (
            ["--seconds", "9", "--kinds", "murder"],
            "--kinds murder: there is no such kind; valid kinds: kill, ",
        ),
        (["--lockstep", "--realtime"], "--lockstep and --realtime exclude each other"),
        (
            ["--kills", "3", "--kinds", "kill"],
            "--kills 3 and --kinds kill exclude each other: kills from outside are not",
        ),
        (
            ["--set", "board.upper.ends_run=false"],
            "no board ends the run; give its simulated time with --seconds",
        ),
        (["--set", "clock.wake=no"], 'clock.wake = "no": '),
    ],
)
def test_bad_input_is_refused_in_one_line_with_valid_values(
    small: Path, options: list[str], line: str
) -> None:
    assert line in read_refusal(rack("campaign", small, *options))
