"""Tests `rack plot` as a user runs it: curves, marks, comparisons, pictures, refusals."""

from __future__ import annotations

import json
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest

from rack.boards import Rack
from rack.boards.config import RackConfig, load
from tests.processes import wait_until
from tests.shared_runs import slow_run, small_run
from tests.tools.command_line import rack, read_answer, read_refusal
from tests.tools.held_racks import held_rack
from tests.tools.recordings import add_events, cycle, recorded

COUNT, STATE = "lower.status.count", "lower.status.state"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small run, with a fault, a detection, a lost board and its restart."""
    folder = small_run(tmp_path_factory)
    add_events(
        folder,
        (400, "fault", "begins", "begins it"),
        (404, "detection", "hang", "hang it"),
        (404, "died", "died", "died it"),
        (500, "recovery", "rejoined", "rejoined it"),
        (600, "fault", "ends", "ends it"),
    )
    return folder


def test_curves_and_marks_are_printed_in_80_columns_without_colours(run: Path) -> None:
    shown = rack("plot", run, COUNT, STATE)
    assert (shown.returncode, shown.stderr) == (0, "")
    assert "\x1b" not in shown.stdout
    lines = shown.stdout.splitlines()
    assert max(map(len, lines)) == 80
    assert lines[0].strip() == COUNT
    assert lines[-4:] == [
        "A fault, 1 s: lower: begins it",
        "B detection, 1.01 s: lower: hang it",
        "C lost, 1.01 s: lower: died it",
        "D restart, 1.25 s: lower: rejoined it",
    ]
    assert "executing" in shown.stdout


def test_the_values_of_a_window_are_those_of_the_recording(run: Path) -> None:
    found = read_answer("plot", run, COUNT, STATE, "--from", 1, "--to", 1.005)
    count, state = found["curves"]
    assert count["time_s"] == pytest.approx([1.0, 1.0025, 1.005])
    assert count["values"] == sorted(count["values"])
    assert set(state["values"]) <= {"idle", "executing", "done"}
    assert [mark["kind"] for mark in found["marks"]] == ["fault"]
    assert (found["window_s"], found["picture"]) == ([1.0, 1.005], None)


def test_a_condition_chooses_the_window(run: Path) -> None:
    (whole,) = read_answer("plot", run, COUNT)["curves"]
    middle = whole["values"][len(whole["values"]) // 2]
    condition = f"{COUNT} >= {middle}"
    found = read_answer("plot", run, COUNT, "--when", condition)
    (trigger,) = [mark for mark in found["marks"] if mark["kind"] == "trigger"]
    first = next(at for at, value in enumerate(whole["values"]) if value >= middle)
    at_s = whole["time_s"][first]
    assert (trigger["time_s"], trigger["text"]) == (at_s, condition)
    assert found["window_s"] == pytest.approx([max(at_s - 0.5, 0.0), min(at_s + 1.0, 4.0)])


@pytest.mark.slow
def test_the_curves_of_two_runs_are_plotted_in_one_panel(
    run: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    slow = slow_run(tmp_path_factory)
    found = read_answer("plot", run, COUNT, "--against", slow)
    here, there = found["curves"]
    # The folders have the same name.
    assert (here["run"], there["run"]) == (str(run), str(slow))
    assert here["values"] != there["values"]
    slow.rename(tmp_path / "slow")
    shown = rack("plot", run, COUNT, "--against", tmp_path / "slow").stdout.splitlines()
    assert "0 run  1 slow" in [line.strip() for line in shown]


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_a_picture_is_saved_by_its_suffix(run: Path, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"plot.{suffix}"
    shown = rack("plot", run, COUNT, STATE, "--out", path)
    assert (shown.stdout, shown.stderr) == (f"picture: {path}\n", "")
    if suffix == "png":
        assert path.read_bytes().startswith(b"\x89PNG")
    else:
        assert ElementTree.parse(path).getroot().tag.endswith("svg")
        # matplotlib draws letters as shapes, and names each text in a comment.
        text = path.read_text()
        assert "<!-- simulated time, s -->" in text
        assert "<!-- fault, 1 s: lower: begins it -->" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("lower.status.cuont",), "lower.status.cuont: no such signal; nearest: lower.status.cou"),
        (("lower.status.count[3]",), "lower.status.count[3]: no such index"),
        (("lower.status.reason",), "lower.status.reason: is a text; only numbers can be plotted"),
        ((COUNT, "--from", "3", "--to", "2"), "--from 3 --to 2: must be 0 <= FROM < TO <= 4 s"),
        ((COUNT, "--from", "2", "--to", "2"), "--from 2 --to 2: must be 0 <= FROM < TO <= 4 s"),
        ((COUNT, "--to", "5"), "--from 0 --to 5: must be 0 <= FROM < TO <= 4 s"),
        ((COUNT, "--from", "nan"), "--from nan --to 4: must be 0 <= FROM < TO <= 4 s"),
        ((COUNT, "--out", "plot.jpg"), "--out plot.jpg: the name of a picture must end in .png or"),
        ((COUNT, "--out", "nowhere/plot.png"), '"nowhere/plot.png": No such file or directory'),
        ((COUNT, "--against", "nowhere"), "nowhere: not a run: it has no config.toml"),
        ((COUNT, "--against", "origin"), "--against origin: "),
        ((COUNT, "--when", "count = 3"), '"count = 3" is not a condition; write one like'),
    ],
)
def test_bad_arguments_are_refused_in_one_line(
    run: Path, tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    assert read_refusal(rack("plot", run, *words, folder=tmp_path)).startswith(message)
    assert [*tmp_path.iterdir()] == []


def test_a_condition_that_never_holds_is_named(run: Path) -> None:
    refusal = read_refusal(rack("plot", run, COUNT, "--when", f"{COUNT} < 0"), status=1)
    assert refusal == f"{COUNT} < 0: does not hold from 0 to 4 s"


def test_a_signal_without_messages_is_named(tmp_path: Path) -> None:
    recorded(tmp_path / "run", load("fig2"), {"level": [cycle(0, 2000, 0, 0, 1, 3, 4)]})
    refusal = read_refusal(rack("plot", tmp_path / "run", "level.status.state"))
    assert refusal == "level.status.state: no message of level.status is recorded"


@pytest.mark.parametrize(
    ("package", "words", "missing"),
    [
        ("plotext", (), "no curves without plotext: pip install 'nasrem-rack[live]'; --out FILE"),
        ("matplotlib", ("--out", "a.png"), "no pictures: they need matplotlib: pip install 'nasr"),
    ],
)
def test_without_a_package_the_line_that_installs_it_is_printed(
    run: Path, monkeypatch: pytest.MonkeyPatch, package: str, words: tuple[str, ...], missing: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    assert read_refusal(rack("plot", run, COUNT, *words), status=1).startswith(missing)


@pytest.mark.slow
def test_of_a_running_rack_the_recording_so_far_is_plotted(tmp_path: Path, rack_name: str) -> None:
    with held_rack(tmp_path, rack_name, "--out", tmp_path / "run"):
        assert rack("step", rack_name, "--ticks", "200").returncode == 0
        found: dict[str, Any] = {}

        def has_curves() -> bool:
            found.update(json.loads(rack("plot", rack_name, "counter.status.row", "--json").stdout))
            return "curves" in found

        # The recorder writes a little later than the rack.
        wait_until(has_curves)
    assert found["curves"][0]["time_s"][:3] == pytest.approx([0.0, 0.01, 0.02])
    assert found["title"] == rack_name


@pytest.mark.slow
def test_a_rack_that_is_not_recorded_is_refused(config: RackConfig) -> None:
    with Rack(config):
        refusal = read_refusal(rack("plot", config.name, COUNT), status=1)
    what_to_do = f"'rack record {config.name}' records it"
    assert refusal == f"{config.name}: the rack is not recorded; {what_to_do}"
