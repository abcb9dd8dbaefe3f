"""`rack analyze`: a run against the timing model, as a user sees it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rack.backplane.trace import SKIPPED_SHIFT, Flag
from rack.boards.config import load
from rack.tools.live.display import Display
from rack.tools.live.launch import run_rack
from rack.tools.timing.analysis.analysis import Analysis
from rack.tools.timing.analysis.tables import document
from tests.shared_runs import slow_run
from tests.tools.analysis_text import brief, text
from tests.tools.command_line import rack
from tests.tools.recordings import MS, Cycle, recorded

MISSED, SKIPPED = int(Flag.MISSED), int(Flag.SKIPPED)
SETTLED = 40
PLAIN = (0.0, 0.1, 1.0, 0.1)
BUDGET = [
    "board.lower.budget.process_ms=1.0",
    "board.lower.budget.read_ms=0.2",
    "board.lower.budget.write_ms=0.2",
]
USUAL = ["--percentile", "50"]
"""What a machine whose host stalls it cannot change."""


def run_of(figure: str, name: str, folder: Path) -> Path:
    """Run the rack of a figure in real time for 1.5 s; return its folder."""
    run_rack(load(figure, [f"name={name}"]), 1.5, folder, Display())
    return folder


def verdicts(found: dict[str, Any], side: str) -> dict[tuple[str, str], bool]:
    """Return which equations hold on which subjects, on one side of the document."""
    return {
        (row["equation"], row["subject"]): row[side]["holds"]
        for row in found["equations"]
        if row[side] is not None
    }


@pytest.mark.slow
@pytest.mark.alone
def test_a_rack_that_is_predicted_to_hold_is_seen_to_hold(rack_name: str, tmp_path: Path) -> None:
    done = rack("analyze", run_of("fig4", rack_name, tmp_path / "run"), *USUAL, "--json")
    found = json.loads(done.stdout)
    assert (done.returncode, found["holds"]) == (0, True), done.stderr
    predicted, measured = verdicts(found, "predicted"), verdicts(found, "measured")
    assert all(predicted.values())
    assert {
        ("3.1", "level"),
        ("3.6", "level"),
        ("response time", "level"),
        ("load", "core 1"),
    } <= set(measured)
    assert all(measured.values())
    assert not any(row["disagrees"] for row in found["equations"])
    level = found["levels"]["level"]
    assert level["measured"]["execution_ns"] == pytest.approx(
        level["predicted"]["execution_ns"], rel=0.1
    )
    assert level["measured"]["plan_ns"] == pytest.approx(level["predicted"]["plan_ns"], rel=0.1)
    assert json.loads((tmp_path / "run" / "analysis.json").read_text()) == found


@pytest.mark.slow
@pytest.mark.alone
def test_a_rack_that_is_predicted_to_fail_is_seen_to_fail(rack_name: str, tmp_path: Path) -> None:
    folder = run_of("fig4-overload", rack_name, tmp_path / "run")
    done = rack("analyze", folder, *USUAL, "--out", tmp_path / "analysis", "--verbose")
    assert done.returncode == 1, done.stderr
    assert [path.name for path in (tmp_path / "analysis").iterdir()] == ["analysis.json"]
    found = json.loads((tmp_path / "analysis" / "analysis.json").read_text())
    for side in ("predicted", "measured"):
        failed = {key for key, holds in verdicts(found, side).items() if not holds}
        assert {
            ("3.1", "level"),
            ("3.6", "level"),
            ("response time", "level"),
            ("load", "core 1"),
        } <= failed
    assert "failed: level 3.1" in done.stdout


@pytest.mark.parametrize(
    ("missed", "said"),
    [
        pytest.param(0, "no cycle missed or skipped", marks=pytest.mark.slow),
        (3, "3 cycles missed, 2 skipped"),
    ],
)
def test_what_matters_comes_first_and_the_tables_on_demand(
    small: Path, tmp_path: Path, missed: int, said: str
) -> None:
    config = load(small, ["clock.mode=realtime", *BUDGET])
    counts = {"missed": missed, "skipped": 2 * (missed > 0)}
    outcome = {"kind": "outcome", "outcome": {"cause": "task done"}, "tasks": {"lower": counts}}
    traces = {name: [Cycle(SETTLED + k, PLAIN) for k in range(40)] for name in ("lower", "upper")}
    folder = recorded(tmp_path / "run", config, traces, [outcome]).folder
    done = rack("analyze", folder)
    assert (done.returncode, done.stderr) == (0, "")
    found = done.stdout.splitlines()
    assert found[0] == f"small: task done, {said}"
    assert found[1].startswith("all ")
    assert found[1].endswith(" equations held")
    (tightest,) = [line for line in found if line.startswith("tightest: ")]
    assert tightest.endswith("% left")
    assert "to do: nothing" in found
    assert "--verbose shows every level, task and equation" in found
    assert found[-1] == f"{folder}/analysis.json"
    more = rack("analyze", folder, "--verbose").stdout.splitlines()
    assert more[:4] == found[:4]
    assert any(line.startswith("Equations: ") for line in more)
    assert not any(line.startswith("Equations: ") for line in found)


def test_a_folder_without_a_run_is_refused_in_one_line(tmp_path: Path) -> None:
    done = rack("analyze", tmp_path)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "not a run" in done.stderr


def test_predicted_and_measured_that_differ_are_marked(small: Path, tmp_path: Path) -> None:
    config = load(small, ["clock.mode=realtime", *BUDGET])
    trace = [
        Cycle(SETTLED + k, (0.0, 0.1, 2.6 if k == 7 else 1.0, 0.1), flags=int(k == 7))
        for k in range(40)
    ]
    analysis = Analysis.of(recorded(tmp_path / "run", config, {"lower": trace}))
    differing = {pair.equation for pair in analysis.pairs if pair.disagrees}
    assert differing >= {"3.1", "3.6", "response time"}
    assert not analysis.holds
    found = text(analysis)
    assert "not as predicted: lower 3.1" in found
    assert f"to do: rack check CONFIG --from {tmp_path / 'run'} lists changes" in found
    levels = [line.split()[:5] for line in found.splitlines() if line.startswith("lower  ")]
    assert ["lower", "predicted", "2.5", "1", "0.4"] in levels
    assert ["lower", "measured", "2.5", "2.6", "0.2"] in levels
    assert "never ran: upper\nmade no plan: lower\n" in found


def test_a_stall_that_is_rare_fails_the_worst_cycle_and_not_most(
    small: Path, tmp_path: Path
) -> None:
    config = load(small, ["clock.mode=realtime", *BUDGET])
    trace = [Cycle(SETTLED + k, (0.0, 0.1, 2.6 if k == 7 else 1.0, 0.1)) for k in range(400)]
    recording = recorded(tmp_path / "run", config, {"lower": trace})
    analysis = Analysis.of(recording)
    assert not analysis.holds
    assert "failed in more than 1 of 100 cycles: none" in text(analysis)
    assert "to do: nothing about the config: it failed in single cycles" in brief(analysis)
    assert "to do: nothing\n" in brief(Analysis.of(recording, 99.0))
    assert Analysis.of(recording, 99.0).holds


@pytest.mark.parametrize(
    ("last", "mode", "broken"),
    [
        (Cycle(SETTLED + 8, PLAIN), "realtime", {}),
        (
            Cycle(SETTLED + 8, (0.0, 0.1, 3.0, 0.1), flags=MISSED),
            "realtime",
            {"3.1": (3.2, 2.5), "3.6": (0.0, -0.7), "3.5": (3.2, 2.5), "response time": (3.2, 2.5)},
        ),
        # It waited, and computed as usual.
        (
            Cycle(SETTLED + 8, PLAIN, late=9.0, flags=MISSED),
            "realtime",
            {"response time": (10.2, 2.5)},
        ),
        # Its message came too late, whenever it ended.
        (Cycle(SETTLED + 8, PLAIN, flags=MISSED), "realtime", {"response time": (2.500001, 2.5)}),
        # Three releases were skipped; before the cycle after it rows were lost, but no cycle was.
        (
            Cycle(SETTLED + 11, PLAIN, flags=SKIPPED | 3 << SKIPPED_SHIFT),
            "realtime",
            {"3.7": (10.0, 2.5)},
        ),
        (Cycle(SETTLED + 8, PLAIN, late=9.0), "lockstep", {}),
    ],
)
def test_the_equations_are_put_to_the_worst_cycle(
    small: Path, tmp_path: Path, last: Cycle, mode: str, broken: dict[str, tuple[float, float]]
) -> None:
    config = load(small, [f"clock.mode={mode}", "timing.context_switch_ms=0.1"])
    trace = [*(Cycle(SETTLED + k, PLAIN) for k in range(8)), last, Cycle(SETTLED + 15, PLAIN)]
    analysis = Analysis.of(recorded(tmp_path / "run", config, {"lower": trace}))
    found = {
        pair.equation: (pair.measured.left / MS, pair.measured.right / MS)
        for pair in analysis.pairs
        if pair.measured is not None and pair.fails and pair.subject == "lower"
    }
    assert found == {name: pytest.approx(sides, abs=1e-6) for name, sides in broken.items()}


@pytest.mark.parametrize(
    ("outcome", "to_do"),
    [
        ({"cause": "task done"}, "nothing\n"),
        ({"cause": "time over", "faults": []}, "nothing\n"),
        ({"cause": "task failed"}, "rack report "),
        ({"cause": "time over", "faults": ["emergency stop"]}, "rack report "),
    ],
)
def test_a_run_that_failed_has_something_to_do(
    small: Path, tmp_path: Path, outcome: dict[str, Any], to_do: str
) -> None:
    config = load(small, ["clock.mode=realtime", *BUDGET])
    traces = {name: [Cycle(SETTLED + k, PLAIN) for k in range(40)] for name in ("lower", "upper")}
    ended = {"kind": "outcome", "outcome": outcome, "tasks": {}}
    analysis = Analysis.of(recorded(tmp_path / "run", config, traces, [ended]))
    assert analysis.holds
    assert f"to do: {to_do}" in brief(analysis)


def test_a_level_that_is_late_though_its_times_fit_is_not_referred_to_the_check(
    small: Path, tmp_path: Path
) -> None:
    config = load(small, ["clock.mode=realtime", *BUDGET])
    late = [Cycle(SETTLED + k, PLAIN, late=3.0) for k in range(40)]
    analysis = Analysis.of(recorded(tmp_path / "run", config, {"lower": late}))
    assert not analysis.holds
    assert "to do: nothing about the config: its levels' own times fit" in brief(analysis)


def test_alpha_and_deviation_are_those_of_equation_3_6(small: Path, tmp_path: Path) -> None:
    trace = [Cycle(SETTLED, (0.0, 0.1, 2.0, 0.1)), Cycle(SETTLED + 1, (0.0, 0.4, 1.0, 0.1))]
    recording = recorded(tmp_path / "run", load(small, ["clock.mode=realtime"]), {"lower": trace})
    found = document(Analysis.of(recording))
    # 2.5 less the longest execution and the longest communication, each part at its longest.
    assert found["levels"]["lower"]["measured"]["residual_ns"] == pytest.approx(0, abs=1)
    # Residuals of 0.3 and 1.0 ms.
    assert found["tasks"]["lower"]["deviation_ms"] == pytest.approx(0.35)
    assert found["levels"]["lower"]["predicted"] is None


def test_lateness_and_gaps_are_those_of_the_wall_clock(small: Path, tmp_path: Path) -> None:
    trace = [Cycle(SETTLED + k, PLAIN, late=0.3 if k == 5 else 0.1) for k in (*range(8), 11)]
    traces = {"lower": trace}
    found = document(
        Analysis.of(recorded(tmp_path / "a", load(small, ["clock.mode=realtime"]), traces))
    )
    task = found["tasks"]["lower"]
    assert (task["lateness_ms"]["max"], task["lateness_ms"]["p50"]) == (0.3, 0.1)
    assert task["largest_gap_ms"] == 4 * 2.5
    assert found["core_loads"] == {"core 0": pytest.approx(1.2 / 2.5)}
    lockstep = Analysis.of(recorded(tmp_path / "b", load(small), traces))
    task = document(lockstep)["tasks"]["lower"]
    assert (task["lateness_ms"], task["largest_gap_ms"], task["residual_ms"]) == (None, None, None)
    assert "late max" not in text(lockstep)
    assert "lockstep: no deadlines, no lateness" in text(lockstep)


@pytest.mark.parametrize("width", [80, 120])
def test_the_tables_of_an_analysis_fit_the_terminal(
    small: Path, tmp_path: Path, width: int
) -> None:
    traces = {name: [Cycle(SETTLED + k, PLAIN) for k in range(8)] for name in ("lower", "upper")}
    analysis = Analysis.of(recorded(tmp_path / "a", load(small, ["clock.mode=realtime"]), traces))
    lines = text(analysis, width).splitlines()
    rows = [
        line
        for line in lines
        if line.startswith(
            ("lower ", "upper ", "3.", "response", "load", "task ", "eq. ", "level ")
        )
    ]
    assert len(rows) >= 20
    assert max(map(len, rows)) <= width
    assert max(map(len, text(analysis).splitlines())) > 120


@pytest.mark.slow
def test_a_run_in_lockstep_is_analyzed_with_its_system_response(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    found = json.loads(rack("analyze", slow_run(tmp_path_factory), "--json").stdout)
    measured = [
        (row["equation"], row["measured"])
        for row in found["equations"]
        if row["measured"] is not None
    ]
    # 40 and 5 ticks: a command takes both cycles, a status waits for up to 35 ticks more.
    responses = [
        (found["left"], found["right"]) for equation, found in measured if equation == "3.3"
    ]
    assert responses == [(45 * 2.5 * MS, 45 * 2.5 * MS), (80 * 2.5 * MS, 80 * 2.5 * MS)]
    assert "response time" not in dict(measured)
