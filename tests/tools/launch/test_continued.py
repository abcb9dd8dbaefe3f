"""Tests `rack run --from RUN@TIME`: continued and repeated runs, and refusals."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from shutil import copytree

import pytest

from rack.tools.console.answer import Failure
from rack.tools.recording.checksums import Checksums
from rack.tools.recording.file_names import ORIGIN
from rack.tools.recording.recording import Recording
from rack.tools.report.report import write_report
from tests.conftest import SMALL
from tests.tools.command_line import rack

SECONDS = 2.0


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 2 s."""
    folder = tmp_path_factory.mktemp("recorded")
    small = folder / "small.toml"
    small.write_text(SMALL)
    done = rack(
        *("run", small, "--lockstep", "--seconds", SECONDS),
        *("--set", f"name=test-continued-{os.getpid()}", "--out", folder / "one", "--json"),
    )
    assert done.returncode == 0, done.stderr
    return folder / "one"


@pytest.fixture
def run(recorded: Path, tmp_path: Path) -> Path:
    """A copy of that run, which a test may change."""
    return Path(copytree(recorded, tmp_path / "one"))


def content(run: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_a_continued_run_is_recorded_with_its_origin(run: Path, tmp_path: Path) -> None:
    before = content(run)
    two = tmp_path / "two"
    done = rack(
        *("run", "--from", f"{run}@1.2", "--seconds", SECONDS, "--out", two, "--json"),
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["digest"] == json.loads((run / "report.json").read_text())["digest"]
    assert report["recording"] == "complete"
    # Nothing that could be run.
    kinds = {".toml", ".jsonl", ".json", ".md", ".parquet", ".rrd", ".xxh128"}
    assert {path.suffix for path in two.rglob("*") if path.is_file()} <= kinds
    one, other = Recording(run), Recording(two)
    for name in other.mailboxes:
        serials = other.read_signal(name, "serial")
        assert other.read_signal(name, "tick")[0] >= 480
        assert serials.tolist() == one.read_signal(name, "serial")[-len(serials) :].tolist()
    assert other.read_trace("lower")["tick"][[0, -1]].tolist() == [480, 799]
    assert report["continues"] == {
        "folder": str(run),
        "tick": 480,
        "time_s": 1.2,
        "launched_ns": one.launch.created_ns,
    }
    assert f"continues {run} from 1.2 s" in " ".join(rack("report", two).stdout.split())
    assert content(run) == before
    assert json.loads(rack("report", run, "--json").stdout)["continues"] is None


@pytest.mark.slow
def test_the_origin_of_a_branch_is_found_only_if_it_is_unchanged(
    run: Path, small: Path, rack_name: str, tmp_path: Path
) -> None:
    rack("run", "--from", f"{run}@1.2", "--seconds", SECONDS, "--out", tmp_path / "two", "--json")
    moved = tmp_path / "moved"
    moved.mkdir()
    for folder in (run, tmp_path / "two"):
        folder.rename(moved / folder.name)
    against = ("report", moved / "two", "--against", "origin")
    found = json.loads(rack(*against, "--json").stdout)["against"]
    assert (found["folder"], found["first_difference"]) == (str(moved / "one"), None)
    (moved / "one").rename(moved / "elsewhere")
    names = ("--set", f"name={rack_name}", "--out", run)
    rack("run", small, "--lockstep", "--seconds", SECONDS, *names)
    refused = rack(*against)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1), refused.stderr
    assert f"continues {run}, but that run no longer exists" in refused.stderr


@pytest.mark.slow
def test_an_invalid_origin_is_refused(run: Path) -> None:
    (run / ORIGIN).write_text("{}")
    with pytest.raises(Failure, match=r"origin\.json: damaged, or changed later"):
        write_report(run)


@pytest.mark.slow
def test_a_run_in_an_outage_has_no_state_and_the_time_is_refused(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    script = tmp_path / "kill.toml"
    script.write_text('[[fault]]\nkind = "kill"\nboard = "lower"\ntick = 440\n')
    one = tmp_path / "one"
    common = ("--seconds", SECONDS, "--json")
    names = ("--set", f"name={rack_name}", "--out", one, "--faults", script)
    whole = rack("run", small, "--lockstep", *names, *common)
    refused = rack("run", "--from", f"{one}@1.2", "--no-record", *common)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1), refused.stderr
    assert "1.2: a board is lost at this time" in refused.stderr
    # Back, and restarted, it goes on; the loss counts.
    later = rack("run", "--from", f"{one}@1.8", "--no-record", *common)
    assert json.loads(later.stdout)["digest"] == json.loads(whole.stdout)["digest"]


@pytest.mark.slow
def test_a_state_that_differs_from_the_recording_is_noted(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    code = (Path(__file__).parents[2] / "two_levels.py").read_text()
    levels = tmp_path / "changing_levels.py"
    levels.write_text(code)
    text = small.read_text().replace("two_levels:", "changing_levels:")
    small.write_text(text.replace("python_path = [", f'python_path = ["{tmp_path}", '))
    one = tmp_path / "one"
    names = ("--set", f"name={rack_name}", "--out", one)
    rack("run", small, "--lockstep", "--seconds", SECONDS, *names)
    again = ("run", "--from", f"{one}@1.2", "--seconds", SECONDS, "--no-record", "--json")
    assert not rack(*again).stderr
    levels.write_text(code.replace(".count + 1", ".count + 1 + 1"))
    refused = rack(*again)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert f"since it was recorded, these have changed: {levels}; --anyway" in refused.stderr
    done = rack(*again, "--anyway")
    assert f"these have changed: {levels}; digests may differ" in done.stderr
    first = r"first upper\.command at tick 0, goal was 1, is 2"
    why = f"upper.command, .* are not as recorded: {first}: the code of a level has changed since"
    assert re.search(why, done.stderr), done.stderr


@pytest.mark.slow
def test_a_run_that_continues_another_is_continued(run: Path, tmp_path: Path) -> None:
    two = tmp_path / "two"
    common = ("--seconds", SECONDS, "--json")
    done = rack("run", "--from", f"{run}@0.5", "--out", two, *common)
    last = rack("run", "--from", f"{two}@1.5", "--no-record", *common)
    assert json.loads(last.stdout)["digest"] == json.loads(done.stdout)["digest"]
    # Its beginning is the other's.
    run.rename(tmp_path / "elsewhere")
    refused = rack("run", "--from", f"{two}@0.6", "--no-record")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert f"continues {run}, but that run no longer exists" in refused.stderr


@pytest.mark.slow
@pytest.mark.parametrize("at", ["2", "-1", "nan", "inf", "soon"])
def test_a_time_outside_the_run_is_refused(recorded: Path, tmp_path: Path, at: str) -> None:
    refused = rack("run", "--from", f"{recorded}@{at}", "--out", tmp_path / "two")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert f"{at}: must be 0 to 1.9975 s" in refused.stderr
    assert not (tmp_path / "two").exists()


@pytest.mark.slow
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
    refused = rack("run", *arguments, folder=tmp_path)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1), refused.stderr
    assert why in refused.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_run_of_an_older_version_needs_the_option_anyway(run: Path, tmp_path: Path) -> None:
    again = ("run", "--from", f"{run}@1.2", "--seconds", SECONDS, "--no-record", "--json")
    code = run / "code.json"
    code.write_text(code.read_text().replace('"rack": "', '"rack": "0'))
    Checksums(run).store(code.name)
    refused = rack(*again)
    assert "since it was recorded, these have changed: the code of rack; --any" in refused.stderr
    code.unlink()
    refused = rack(*again)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "it has no code.json, because 'rack record' or an older version" in refused.stderr
    done = rack(*again, "--anyway")
    assert (
        json.loads(done.stdout)["digest"] == json.loads((run / "report.json").read_text())["digest"]
    )


@pytest.mark.slow
def test_a_fault_detected_before_a_branch_is_judged_as_in_the_whole_run(tmp_path: Path) -> None:
    small, script = tmp_path / "small.toml", tmp_path / "mute.toml"
    small.write_text(SMALL)
    script.write_text('[[fault]]\nkind = "mute"\nboard = "upper"\nat = 0.4\nfor = "400ms"\n')
    name = f"name=test-judged-{os.getpid()}"
    whole, branch, second = (tmp_path / run for run in ("whole", "branch", "second"))
    rack("run", small, "--lockstep", "--seconds", 1.2, "--faults", script, "--set", name,
         "--out", whole)  # fmt: skip
    for origin, out in ((f"{whole}@0.6", branch), (f"{branch}@0.7", second)):
        rack("run", "--from", origin, "--seconds", 1.2, "--out", out)
    reports = [json.loads((run / "report.json").read_text()) for run in (whole, branch, second)]
    (fault,) = reports[0]["faults"]
    assert (fault["seen"], fault["found_as"], fault["is_within"]) == ("detected", "mute", True)
    assert fault["struck"] + fault["delay"] < 240
    assert [report["faults"] for report in reports[1:]] == [[fault], [fault]]
    assert not any(report["unexplained"] for report in reports)
