"""Tests `rack run --from RUN@TIME`: continued and repeated runs, and refusals."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import copytree, rmtree
from subprocess import CompletedProcess
from typing import Any

import pytest

from rack.tools.launch.continued import parse_tick
from rack.tools.recording.checksums import Checksums
from rack.tools.recording.file_names import ORIGIN
from rack.tools.recording.recording import Recording
from rack.tools.report.report import write_report
from tests.conftest import SMALL
from tests.tools.command_line import rack, read_answer, read_failure, read_refusal

pytestmark = pytest.mark.slow

SECONDS = 0.8
FAULTS = """
fault = [
    { kind = "mute", board = "upper", tick = 24, for = "100ms" },
    { kind = "kill", board = "lower", tick = 160 },
]
"""
BETWEEN_S, LOST_S, BACK_S = 0.2, 0.42, 0.6
"""Times between the faults, in the outage by the second one, and after it."""
LEVELS = (Path(__file__).parents[2] / "two_levels.py").read_text()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the runs and of the code of their levels."""
    return tmp_path_factory.mktemp("continued")


@pytest.fixture(scope="module")
def recorded(folder: Path) -> Path:
    """A run with two faults."""
    (folder / "changing_levels.py").write_text(LEVELS)
    (folder / "faults.toml").write_text(FAULTS)
    text = SMALL.replace("two_levels:", "changing_levels:")
    small = folder / "small.toml"
    small.write_text(text.replace("python_path = [", f'python_path = ["{folder}", '))
    done = rack(
        *("run", small, "--lockstep", "--seconds", SECONDS, "--faults", folder / "faults.toml"),
        *("--set", f"name=test-continued-{os.getpid()}", "--out", folder / "one", "--json"),
        *("--set", "supervision.lockstep_restart_s=0.05"),
    )
    assert done.returncode == 0, done.stderr
    return folder / "one"


def continued(run: Path, at_s: float, *options: object) -> CompletedProcess[str]:
    return rack("run", "--from", f"{run}@{at_s}", "--seconds", SECONDS, *options)


@pytest.fixture(scope="module")
def branch(recorded: Path, folder: Path) -> Path:
    """A run that continues that one, between its faults."""
    before = content(recorded)
    done = continued(recorded, BETWEEN_S, "--out", folder / "two", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert content(recorded) == before
    assert json.loads(done.stdout)["recording"] == "complete"
    return folder / "two"


@pytest.fixture(scope="module")
def second(branch: Path, folder: Path) -> Path:
    """A run that continues the continued one, after the outage."""
    done = continued(branch, BACK_S, "--out", folder / "three", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    return folder / "three"


@pytest.fixture
def run(recorded: Path, tmp_path: Path) -> Path:
    """A copy of the first run, which a test may change."""
    return Path(copytree(recorded, tmp_path / "one"))


@contextmanager
def moved(run: Path, to: Path) -> Iterator[Path]:
    """Have a run at another place."""
    yield run.rename(to)
    if run.exists():
        rmtree(run)
    to.rename(run)


def content(run: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}


def read_report(run: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((run / "report.json").read_text())
    return report


def test_a_continued_run_is_recorded_with_its_origin(recorded: Path, branch: Path) -> None:
    report = read_report(branch)
    assert report["digest"] == read_report(recorded)["digest"]
    # Nothing that could be run.
    kinds = {".toml", ".jsonl", ".json", ".md", ".parquet", ".rrd", ".xxh128"}
    assert {path.suffix for path in branch.rglob("*") if path.is_file()} <= kinds
    one, other = Recording(recorded), Recording(branch)
    for name in other.mailboxes:
        serials = other.read_signal(name, "serial")
        assert other.read_signal(name, "tick")[0] >= 80
        assert serials.tolist() == one.read_signal(name, "serial")[-len(serials) :].tolist()
    assert other.read_trace("lower")["tick"][[0, -1]].tolist() == [80, 319]
    origin = {"folder": str(recorded), "tick": 80, "time_s": BETWEEN_S}
    assert report["continues"] == {**origin, "launched_ns": one.launch.created_ns}
    said = " ".join(rack("report", branch).stdout.split())
    assert f"continues {recorded} from {BETWEEN_S} s" in said
    assert read_answer("report", recorded)["continues"] is None


def test_the_origin_of_a_branch_is_found_only_if_it_is_unchanged(
    recorded: Path, branch: Path, tmp_path: Path
) -> None:
    with moved(branch, tmp_path / "two") as two:
        against = ("report", two, "--against", "origin")
        with moved(recorded, tmp_path / "one") as one:
            found = read_answer(*against)["against"]
            assert (found["folder"], found["first_difference"]) == (str(one), None)
        with moved(recorded, tmp_path / "elsewhere"):
            # Another run is there.
            copytree(two, recorded)
            refused = rack(*against)
        assert f"continues {recorded}, but that run no longer exists" in read_refusal(refused)


def test_an_invalid_origin_is_refused(run: Path) -> None:
    (run / ORIGIN).write_text("{}")
    assert "origin.json: damaged, or changed later" in read_failure(write_report, run)


def test_a_run_in_an_outage_has_no_state_and_the_time_is_refused(
    recorded: Path, second: Path
) -> None:
    refusal = read_refusal(continued(recorded, LOST_S, "--no-record"))
    assert f"{LOST_S}: a board is lost at this time" in refusal
    # Back, and restarted, it goes on; the loss counts.
    assert read_report(second)["digest"] == read_report(recorded)["digest"]


@pytest.mark.thorough
def test_a_state_that_differs_from_the_recording_is_noted(recorded: Path, folder: Path) -> None:
    levels = folder / "changing_levels.py"
    levels.write_text(LEVELS.replace(".count + 1", ".count + 1 + 1"))
    try:
        refused = continued(recorded, BETWEEN_S, "--no-record")
        done = continued(recorded, BETWEEN_S, "--no-record", "--anyway")
    finally:
        levels.write_text(LEVELS)
    changed = f"since it was recorded, these have changed: {levels}; --anyway"
    assert changed in read_refusal(refused)
    assert f"these have changed: {levels}; digests may differ" in done.stderr
    first = r"first upper\.command at tick 0, goal was 1, is 2"
    why = f"upper.command, .* are not as recorded: {first}: the code of a level has changed since"
    assert re.search(why, done.stderr), done.stderr


def test_a_run_that_continues_another_is_continued(
    recorded: Path, branch: Path, second: Path, tmp_path: Path
) -> None:
    assert read_report(second)["digest"] == read_report(branch)["digest"]
    # Its beginning is the other's.
    with moved(recorded, tmp_path / "elsewhere"):
        refusal = read_refusal(continued(branch, LOST_S, "--no-record"))
    assert f"continues {recorded}, but that run no longer exists" in refusal


def test_a_time_outside_the_run_is_refused(recorded: Path, tmp_path: Path) -> None:
    refusal = read_refusal(continued(recorded, SECONDS, "--out", tmp_path / "two"))
    assert f"{SECONDS}: must be 0 to 0.7975 s" in refusal
    assert not (tmp_path / "two").exists()
    for at in ("-1", "nan", "inf", "soon"):
        refusal = read_failure(parse_tick, Recording(recorded), at)
        assert refusal.startswith(f"{at}: must be 0 to 0.7975 s")


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("--from", "runs/none@3"), "--from runs/none@3: runs/none is not a run"),
        (("--from", "runs/none"), "must be RUN@TIME, as in runs/nasrem-1@12.5"),
        (("nasrem", "--from", "runs/none@3"), "give either CONFIG or --from RUN@TIME"),
        ((), "give either CONFIG or --from RUN@TIME"),
    ],
)
def test_a_folder_that_is_not_a_run_is_refused(
    arguments: tuple[object, ...], why: str, tmp_path: Path
) -> None:
    assert why in read_refusal(rack("run", *arguments, folder=tmp_path))
    assert not list(tmp_path.iterdir())


@pytest.mark.thorough
def test_a_run_of_an_older_version_needs_the_option_anyway(run: Path) -> None:
    code = run / "code.json"
    code.write_text(code.read_text().replace('"rack": "', '"rack": "0'))
    Checksums(run).store(code.name)
    refusal = read_refusal(continued(run, BETWEEN_S, "--no-record"))
    assert "since it was recorded, these have changed: the code of rack; --any" in refusal
    code.unlink()
    refusal = read_refusal(continued(run, BETWEEN_S, "--no-record"))
    assert "it has no code.json, because 'rack record' or an older version" in refusal
    done = continued(run, BETWEEN_S, "--no-record", "--anyway", "--json")
    assert json.loads(done.stdout)["digest"] == read_report(run)["digest"]


def test_a_fault_detected_before_a_branch_is_judged_as_in_the_whole_run(
    recorded: Path, branch: Path, second: Path
) -> None:
    reports = [read_report(run) for run in (recorded, branch, second)]
    mute, kill = reports[0]["faults"]
    assert (mute["seen"], mute["found_as"], mute["is_within"]) == ("detected", "mute", True)
    assert mute["struck"] + mute["delay"] < 80
    assert (kill["seen"], kill["struck"]) == ("detected", 160)
    assert [report["faults"] for report in reports[1:]] == [[mute, kill]] * 2
    assert not any(report["unexplained"] for report in reports)
