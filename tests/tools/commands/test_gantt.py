"""Tests `rack gantt` as a user runs it: text, pictures, JSON, and refusals in one line."""

from __future__ import annotations

import re
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from rack.boards.config import load
from rack.tools.console.answer import PIPE_WIDTH
from tests.tools.command_line import rack, read_answer, read_refusal
from tests.tools.recordings import cycle, recorded

ENDLESS = (
    *("--set", "clock.period_ms=0.01", "--set", "timing.clock_ms=0.001"),
    *("--set", "board.level.every=1000000"),
)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run of fig2 that is exact to the millisecond, except for one late plan."""
    ms = (0, 0, 1, 3, 4)
    levels = [cycle(4 * n, 2000, *(1000 * (8 * n + at) for at in ms)) for n in range(20)]
    plans = []
    for n in range(0, 20, 2):
        moments = (4, 4, 4, 14, 23 if n == 10 else 15)
        rows = (1000 * (8 * n + at) for at in moments)
        plans.append(cycle(4 * n, 2000, *rows, planned=True))
    recorded(tmp_path / "run", load("fig2"), {"level": levels, "level.planner": plans})
    return tmp_path / "run"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("fig2", ["RXXWPPPPRXXWPPU-RXXWPPPPRXXWPPU-"]),
        ("fig3", ["RXXWPPRXXWPPRXXWPPRXXWUPRXXWPPRXXWPP"]),
        ("fig4", ["PPPPPPU-----PPPPPPU-----", "CRXXW-CRXXW-CRXXW-CRXXW-"]),
        ("fig4-overload", ["PPPPPPU-----PPPPPPU-----", "CRXXXXWCRXXXXWCRXXXXWCRX"]),
    ],
)
def test_a_figure_is_printed_as_in_the_paper_and_drawn(
    name: str, rows: list[str], tmp_path: Path
) -> None:
    shown = rack("gantt", name, "--out", tmp_path / "out")
    assert (shown.returncode, shown.stderr) == (0, "")
    assert [
        line.split()[-1] for line in shown.stdout.splitlines() if line.startswith("core ")
    ] == rows
    assert ("late: level" in shown.stdout) == (name in ("fig3", "fig4-overload"))
    assert (tmp_path / "out" / "gantt.png").read_bytes().startswith(b"\x89PNG")
    picture = (tmp_path / "out" / "gantt.svg").read_text()
    assert ElementTree.fromstring(picture).tag.endswith("svg")
    # matplotlib draws letters as shapes, and names each text in a comment.
    drawn = re.findall(r"<!-- (.+?) -->", picture)
    assert {name, "time, ms"} <= {*drawn}
    assert ("missed deadline" in drawn) == (name in ("fig3", "fig4-overload"))
    assert str(tmp_path / "out" / "gantt.png") in shown.stdout


@pytest.mark.thorough
def test_the_rows_of_a_large_rack_are_not_wrapped_and_its_times_are_written_in_full(
    tmp_path: Path,
) -> None:
    window = ("--from-ms", 100_000, "--to-ms", 100_040)
    shown = rack("gantt", "nasrem", *window, "--out", tmp_path).stdout.splitlines()
    assert max(map(len, shown)) <= PIPE_WIDTH
    lanes = [line for line in shown if line.startswith("core ")]
    assert len(lanes) == 6
    assert all(re.fullmatch(r"core \d  \w+ +[A-Z.-]{40,76}", line) for line in lanes)
    # They are far enough apart.
    labels = re.findall(r"<!-- ([\d.+e]+) -->", (tmp_path / "gantt.svg").read_text())
    assert labels == ["100000", "100020", "100040"]


@pytest.mark.slow
def test_a_run_is_shown_above_the_schedule_of_its_config(run: Path) -> None:
    shown = rack("gantt", run)
    assert (shown.returncode, shown.stderr) == (0, "")
    # From the plan in the middle of the run, two slices.
    assert "measured, 80 to 112 ms" in shown.stdout
    assert [line.split()[-1] for line in shown.stdout.splitlines() if line.startswith("core ")] == [
        "RXXWPPPPRXXWPPUURXXWUUUPRXXWPPU-",
        "RXXWPPPPRXXWPPU-RXXWPPPPRXXWPPU-",
    ]
    assert "R X W P | R X W P U -: 8 of 10 plans" in shown.stdout
    assert "late: level.planner: 1 of 10 plans" in shown.stdout
    assert "released at 80 ms, due at 96 ms: done at 103 ms, 7 ms late" in shown.stdout
    assert (run / "gantt.png").is_file()


@pytest.mark.slow
def test_without_budgets_a_run_is_shown_alone_and_a_config_has_no_schedule(tmp_path: Path) -> None:
    config = load("fig2")
    level = config.board["level"].model_copy(update={"budget": None})
    bare = config.model_copy(update={"board": {"level": level}})
    rows = [cycle(4 * n, 2000, *[8000 * n] * 4, 8000 * n + 1000) for n in range(9)]
    recorded(tmp_path / "run", bare, {"level": rows})
    found = read_answer("gantt", tmp_path / "run")
    assert [panel["kind"] for panel in found["panels"]] == ["measured"]
    assert "no board has a budget" in found["notes"][0]
    (tmp_path / "bare.toml").write_text(bare.to_toml_text())
    refusal = read_refusal(rack("gantt", tmp_path / "bare.toml"))
    assert "no board has a budget: give [board.<name>.budget]" in refusal


def test_without_matplotlib_a_chart_is_printed_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for arguments in (("fig2",), ("fig2", "--figure", "5")):
        done = rack("gantt", *arguments, "--out", tmp_path / "out")
        assert done.returncode == 0
        missing = "no pictures: they need matplotlib: pip install 'nasrem-rack[charts]'"
        assert done.stdout.splitlines()[-1] == missing
        assert "level" in done.stdout
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_figure_5_is_printed_and_drawn(tmp_path: Path) -> None:
    shown = rack("gantt", "nasrem", "--figure", 5, "--out", tmp_path)
    assert (shown.returncode, shown.stderr) == (0, "")
    assert "task, 1 s: multitasking: coupled tightly, as in the figure" in shown.stdout
    assert (tmp_path / "figure5.png").read_bytes().startswith(b"\x89PNG")
    assert ElementTree.parse(tmp_path / "figure5.svg").getroot().tag.endswith("svg")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nosuch"], "no such file; valid are a path or one of the names "),
        (["configs/tasks"], "configs/tasks: not a run: it has no config.toml"),
        (["crossing", "--set", "board.servo.slot=3"], "slot"),
        (["fig2", "--figure", "3"], "--figure 3: must be 5"),
        (["fig2", "--out", "README.md"], "--out README.md: cannot create the folder: File exists"),
        (["fig2", *ENDLESS], "no schedule: 10 slices of the slowest task, 20000 ms each, hold "),
    ],
)
def test_bad_arguments_are_refused_in_one_line(words: list[str], message: str) -> None:
    assert message in read_refusal(rack("gantt", *words))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--from-ms", 500), "outside the run, which lasts from 0 to 160 ms"),
        (("--set", "clock.speed=2"), "the config of a run cannot be changed"),
    ],
)
def test_a_window_outside_the_run_or_another_config_is_refused(
    run: Path, words: tuple[object, ...], message: str
) -> None:
    assert message in read_refusal(rack("gantt", run, *words))
