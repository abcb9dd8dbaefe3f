"""Campaigns on real racks: small ones, few faults; and what they must notice."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rack.backplane.segment import SHM_FOLDER
from tests.processes import RACK, children_of, named, wait_until
from tests.tools.command_line import BOUND_S, ROOT, rack

pytestmark = pytest.mark.thorough

COMMAND = [*RACK, "campaign"]
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
        if (folder / "trials" / "nominal.json").exists():
            (folder / f"stalls-{os.getpid()}").touch()
            time.sleep(600)
"""


def campaign(config: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return rack("campaign", config, *arguments)


def trials_in(folder: Path) -> list[dict[str, Any]]:
    return [
        json.loads(path.read_text())["finding"]
        for path in sorted((folder / "trials").glob("0*.json"))
    ]


@pytest.mark.slow
def test_every_death_and_hang_of_a_lockstep_campaign_is_found_and_survived(
    small: Path, tmp_path: Path
) -> None:
    out = tmp_path / "campaign"
    options = [
        "--lockstep",
        "--injections",
        "2",
        "--seed",
        "4",
        "--seconds",
        "9",
        "--kinds",
        "kill,hang,self-test",
    ]
    done = campaign(small, *options, "--out", out, "--json")
    report = json.loads(done.stdout)
    assert (done.returncode, done.stderr, report["shortfalls"]) == (0, "", [])
    summary = report["summary"]
    assert (
        summary["injected"]
        == summary["detected"]
        == summary["within_bound"]
        == summary["recovered"]
        == 6
    )
    bounds = {kind: found["wilson"]["detected"] for kind, found in report["by_kind"].items()}
    assert bounds == {kind: [0.34238, 1.0] for kind in ("kill", "hang", "self-test")}
    assert (summary["limits_violated"], summary["left_behind"], summary["unexplained"]) == (0, 0, 0)
    assert summary["tasks_done"] + summary["not_armed"] == summary["trials"] >= 3
    assert json.loads((out / "campaign.json").read_text()) == report
    assert (out / "campaign.md").read_text().startswith(f"# Campaign on {small}, seed 4: passed")
    assert (out / "campaign.png").read_bytes().startswith(b"\x89PNG")
    assert [trial["plan"]["number"] for trial in trials_in(out)] == list(
        range(1, summary["trials"] + 1)
    )
    assert not list(out.glob("*.toml"))


@pytest.mark.slow
def test_boards_killed_from_outside_are_found_and_come_back(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "campaign"
    done = campaign(small, "--lockstep", "--kills", "3", "--seconds", "12", "--out", out, "--json")
    summary = json.loads(done.stdout)["summary"]
    # How fast the Rack hears of a death depends on how busy this machine is.
    assert summary["injected"] == summary["detected"] == summary["recovered"] == 3
    assert (summary["left_behind"], summary["unexplained"]) == (0, 0)
    assert summary["tasks_done"] == summary["trials"]


@pytest.mark.slow
def test_a_trial_that_falls_short_is_kept_as_a_file_that_repeats_it(
    small: Path, tmp_path: Path
) -> None:
    out, options = (
        tmp_path / "campaign",
        ["--lockstep", "--injections", "2", "--seconds", "9", "--kinds", "kill"],
    )
    # In a rack without restarts its first loss is the end: what comes after it does not strike, and
    # is drawn again.
    done = campaign(small, *options, "--set", "supervision.restarts=0", "--out", out, "--json")
    report = json.loads(done.stdout)
    first, second = trials_in(out)
    assert (done.returncode, first["ended"], second["ended"]) == (
        1,
        "safely stopped",
        "safely stopped",
    )
    for trial in (first, second):  # again, two for the one that did not strike
        assert sorted(fault["seen"] for fault in trial["faults"]) == ["detected", "not struck"]
    assert (report["summary"]["injected"], report["summary"]["not_struck"]) == (2, 2)
    assert all(
        "no restart follows" in line or "never undone" in line for line in report["shortfalls"]
    )
    for trial in (first, second):
        path = out / f"trial-{trial['plan']['number']:04}.toml"
        assert tomllib.loads(path.read_text())["fault"] == trial["plan"]["faults"]


@pytest.mark.slow
def test_a_campaign_that_was_killed_goes_on_where_it_was(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "campaign"
    options = [
        "--lockstep",
        "--injections",
        "3",
        "--seconds",
        "9",
        "--kinds",
        "kill,hang",
        "--out",
        str(out),
        "--json",
    ]
    process = subprocess.Popen(
        [*COMMAND, str(small), *options], cwd=ROOT, stdout=subprocess.DEVNULL
    )
    trials = out / "trials"
    try:
        wait_until(lambda: len(list(trials.glob("0*.json"))) > 0, BOUND_S)
    finally:
        process.kill()
        process.wait()
    there = {path.name: path.stat().st_mtime_ns for path in trials.glob("*.json")}
    done = campaign(small, *options)
    summary = json.loads(done.stdout)["summary"]
    assert (done.returncode, summary["injected"], summary["recovered"]) == (0, 6, 6)
    assert {name: (trials / name).stat().st_mtime_ns for name in there} == there
    # What was done is not done again, and another campaign's folder is left alone.
    other = campaign(small, *options, "--seed", "9")
    assert (other.returncode, "holds another campaign; it differs in seed" in other.stderr) == (
        2,
        True,
    )


@pytest.mark.slow
def test_ctrl_c_ends_a_campaign_with_a_report_of_what_was_done(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "campaign"
    options = [
        "--realtime",
        "--injections",
        "99",
        "--seconds",
        "9",
        "--kinds",
        "kill",
        "--faultless",
        "0",
    ]
    options += ["--out", str(out)]
    process = subprocess.Popen(
        [*COMMAND, str(small), *options], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert any(line.endswith(" in real time\n") for line in process.stdout)
        process.send_signal(signal.SIGINT)
        printed, _ = process.communicate(timeout=BOUND_S)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 128 + signal.SIGINT
    assert "Interrupted: results until then." in printed
    report = json.loads((out / "campaign.json").read_text())
    assert (report["interrupted"], report["summary"]["left_behind"]) == (True, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "numbers", [(signal.SIGINT,), (signal.SIGTERM,), (signal.SIGHUP,), (signal.SIGINT,) * 2]
)
def test_a_signal_ends_trials_in_the_middle_of_their_launch_and_keeps_those_before(
    small: Path,
    write: Callable[[str, str], Path],
    tmp_path: Path,
    numbers: tuple[signal.Signals, ...],
) -> None:
    write("stalling.py", STALLING)
    text = small.read_text().replace("python_path = [", f'python_path = ["{tmp_path}", ')
    small.write_text(text.replace("two_levels:Upper", "stalling:Stalling"))
    out = tmp_path / "campaign"
    options = [
        "--lockstep",
        "--injections",
        "9",
        "--seconds",
        "9",
        "--kinds",
        "kill",
        "--out",
        str(out),
        "--json",
    ]
    process = subprocess.Popen(
        [*COMMAND, str(small), *options],
        cwd=ROOT,
        env={**os.environ, "CAMPAIGN": str(out)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        wait_until(lambda: len(list(out.glob("stalls-*"))) == len(os.sched_getaffinity(0)), BOUND_S)
        racks = [f"camp-{worker}x" for worker in children_of(process.pid)]
        for number in numbers:
            process.send_signal(number)
        printed, said = process.communicate(timeout=PROMPT_S)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 128 + numbers[0], said
    assert [path.name for path in (out / "trials").glob("*.json")] == ["nominal.json"]
    if len(numbers) == 1:
        report = json.loads(printed)
        assert (report["interrupted"], report["summary"]["trials"]) == (True, 0)
        assert json.loads((out / "campaign.json").read_text()) == report
    assert racks
    wait_until(lambda: not [name for name in racks if named(name)])
    assert not [
        path.name for path in SHM_FOLDER.iterdir() if any(name in path.name for name in racks)
    ]


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--seconds", "9", "--kinds", "murder"], "--kinds murder: no such kind; kinds: kill, "),
        (["--lockstep", "--realtime"], "--lockstep and --realtime: they exclude each other"),
        (
            ["--kills", "3", "--kinds", "kill"],
            "--kills 3 and --kinds kill: kills from outside are a kind of their own",
        ),
        (["--set", "board.upper.ends_run=false"], "no board ends the run: give --seconds"),
        (["--set", "clock.wake=no"], 'clock.wake = "no": '),
    ],
)
def test_bad_input_is_one_line_that_lists_what_is_valid(
    small: Path, options: list[str], line: str
) -> None:
    done = campaign(small, *options)
    assert (done.returncode, done.stdout) == (2, "")
    (told,) = done.stderr.splitlines()
    assert line in told
