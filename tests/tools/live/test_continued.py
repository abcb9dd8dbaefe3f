"""`rack run --checkpoint S` and `--from RUN@TIME`: what continues, and what is refused, writing
nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rack.boards.checkpoint.format import FOLDER
from rack.tools.recording.recording import Recording
from tests.tools.command_line import rack

SECONDS = 2.0


@pytest.fixture
def run(small: Path, rack_name: str, tmp_path: Path) -> Path:
    """A run of 2 s, with checkpoints at 0.5, 1 and 1.5 s."""
    folder = tmp_path / "one"
    done = rack(
        *("run", small, "--lockstep", "--checkpoint", 0.5, "--seconds", SECONDS),
        *("--set", f"name={rack_name}", "--out", folder, "--json"),
    )
    assert done.returncode == 0, done.stderr
    return folder


def content(run: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_a_recorded_run_continues_and_its_recording_begins_there(run: Path, tmp_path: Path) -> None:
    before = content(run)
    two = tmp_path / "two"
    done = rack("run", "--from", f"{run}@1.2", "--seconds", SECONDS, "--out", two, "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["digest"] == json.loads((run / "report.json").read_text())["digest"]
    assert report["recording"] == "complete"
    assert not [path for path in two.rglob("*") if path.suffix == ".checkpoint"]
    one, other = Recording(run), Recording(two)
    for name in other.mailboxes:
        serials = other.signal(name, "serial")
        assert other.signal(name, "tick")[0] >= 480
        assert serials.tolist() == one.signal(name, "serial")[-len(serials) :].tolist()
    assert other.trace("lower")["tick"][[0, -1]].tolist() == [480, 799]
    assert content(run) == before


@pytest.mark.slow
def test_a_run_in_an_outage_has_no_state_and_the_time_is_refused(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    script = tmp_path / "kill.toml"
    script.write_text('[[fault]]\nkind = "kill"\nboard = "lower"\ntick = 440\n')
    one = tmp_path / "one"
    common = ("--seconds", SECONDS, "--json")
    names = ("--set", f"name={rack_name}", "--out", one, "--faults", script)
    whole = rack("run", small, "--lockstep", "--checkpoint", 0.5, *names, *common)
    refused = rack("run", "--from", f"{one}@1.2", "--no-record", *common)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1), refused.stderr
    assert "1.2: a board is lost then" in refused.stderr
    # Back, and restarted, it goes on; the loss counts.
    later = rack("run", "--from", f"{one}@1.8", "--no-record", *common)
    assert json.loads(later.stdout)["digest"] == json.loads(whole.stdout)["digest"]


@pytest.mark.slow
def test_a_state_that_is_not_as_recorded_is_noted(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    code = (Path(__file__).parents[2] / "two_levels.py").read_text()
    levels = tmp_path / "changing_levels.py"
    levels.write_text(code)
    text = small.read_text().replace("two_levels:", "changing_levels:")
    small.write_text(text.replace("python_path = [", f'python_path = ["{tmp_path}", '))
    one = tmp_path / "one"
    names = ("--set", f"name={rack_name}", "--out", one)
    rack("run", small, "--lockstep", "--checkpoint", 0.5, "--seconds", SECONDS, *names)
    again = ("run", "--from", f"{one}@1.2", "--seconds", SECONDS, "--no-record", "--json")
    assert not rack(*again).stderr
    levels.write_text(code.replace(".count + 1", ".count + 1 + 1"))
    done = rack(*again)
    assert "are not as recorded: the code of a level has changed since" in done.stderr
    assert "upper.command" in done.stderr


@pytest.mark.slow
def test_a_continued_run_takes_checkpoints_that_continue(run: Path, tmp_path: Path) -> None:
    two = tmp_path / "two"
    common = ("--seconds", SECONDS, "--json")
    done = rack(*("run", "--from", f"{run}@0.5", "--checkpoint", 0.75, "--out", two), *common)
    assert sorted(path.name for path in (two / FOLDER).iterdir()) == [
        "000000300.checkpoint",
        "000000600.checkpoint",
    ]
    last = rack("run", "--from", f"{two}@1.5", "--no-record", *common)
    assert json.loads(last.stdout)["digest"] == json.loads(done.stdout)["digest"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at", "why"),
    [
        ("0.4", "0.4: permitted: 0.5 to 1.9975 s, from its first checkpoint to its end"),
        ("2", "2: permitted: 0.5 to 1.9975 s"),
        ("nan", "nan: permitted: 0.5"),
        ("inf", "inf: permitted: 0.5"),
        ("soon", "soon: permitted: 0.5"),
    ],
)
def test_a_time_without_a_checkpoint_before_it_is_refused(
    run: Path, tmp_path: Path, at: str, why: str
) -> None:
    refused = rack("run", "--from", f"{run}@{at}", "--out", tmp_path / "two")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert why in refused.stderr
    assert not (tmp_path / "two").exists()


@pytest.mark.slow
def test_a_damaged_checkpoint_is_refused(run: Path, tmp_path: Path) -> None:
    path = run / FOLDER / "000000400.checkpoint"
    path.write_bytes(path.read_bytes()[:-1])
    refused = rack("run", "--from", f"{run}@1", "--out", tmp_path / "two")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "was cut off or changed: its checksum is wrong" in refused.stderr
    assert not (tmp_path / "two").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("--from", "runs/none@3"), "--from runs/none@3: runs/none is not a run"),
        (("--from", "runs/none"), "permitted: RUN@TIME, as in runs/nasrem-1@12.5"),
        (("nasrem", "--from", "runs/none@3"), "CONFIG, or --from RUN@TIME in its place"),
        ((), "CONFIG, or --from RUN@TIME in its place"),
        (
            ("nasrem", "--lockstep", "--checkpoint", 5, "--no-record"),
            "--checkpoint and --no-record: checkpoints lie in the run's folder",
        ),
        (("ibm", "--lockstep", "--checkpoint", 5), "'program': a host program's state"),
    ],
)
def test_what_has_no_checkpoints_is_refused(
    arguments: tuple[object, ...], why: str, tmp_path: Path
) -> None:
    refused = rack("run", *arguments, folder=tmp_path)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1), refused.stderr
    assert why in refused.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_real_time_has_no_checkpoints(small: Path, rack_name: str, tmp_path: Path) -> None:
    settings = ("--set", f"name={rack_name}", "--set", "clock.mode=realtime")
    refused = rack("run", small, "--checkpoint", 5, *settings, "--out", tmp_path / "one")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "checkpoints are taken in lockstep; add --lockstep" in refused.stderr


@pytest.mark.slow
def test_a_run_without_checkpoints_says_how_it_begins_again(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    folder = tmp_path / "one"
    rack("run", small, "--seconds", 0.2, "--set", f"name={rack_name}", "--out", folder)
    refused = rack("run", "--from", f"{folder}@0.1", "--out", tmp_path / "two")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "has no checkpoints; from its beginning: rack run" in refused.stderr
