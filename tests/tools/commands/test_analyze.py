"""Tests `rack analyze`: a run compared with the timing model, as a user sees it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rack.backplane.trace import SKIPPED_SHIFT, Flag
from rack.boards.config import load
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.report.analysis import Analysis
from tests.tools.analysis_text import brief, text
from tests.tools.command_line import rack
from tests.tools.conftest import Record
from tests.tools.recordings import MS, Cycle

MISSED, SKIPPED = int(Flag.MISSED), int(Flag.SKIPPED)
SETTLED = 40
PLAIN, LONG = (0.0, 0.1, 1.0, 0.1), (0.0, 0.1, 2.6, 0.1)
BUDGET = [
    "board.lower.budget.process_ms=1.0",
    "board.lower.budget.read_ms=0.2",
    "board.lower.budget.write_ms=0.2",
]
USUAL = ["--percentile", "50"]
"""What a machine whose host stalls it cannot change."""


JUDGED = {("3.1", "level"), ("3.6", "level"), ("response time", "level"), ("load", "core 1")}


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.parametrize(("figure", "holds"), [("fig4", True), ("fig4-overload", False)])
def test_a_run_confirms_the_prediction_for_its_rack(
    rack_name: str, tmp_path: Path, figure: str, holds: bool
) -> None:
    run_rack(load(figure, [f"name={rack_name}"]), 0.7, tmp_path / "run", Display())
    done = rack("analyze", tmp_path / "run", *USUAL, "--out", tmp_path / "out", "--json")
    found = json.loads(done.stdout)
    assert (done.returncode, found["holds"]) == (0 if holds else 1, holds), done.stderr
    assert json.loads((tmp_path / "out" / "analysis.json").read_text()) == found
    for side in ("predicted", "measured"):
        seen = {
            (row["equation"], row["subject"]): row[side]["holds"]
            for row in found["equations"]
            if row[side] is not None
        }
        assert all(seen[key] is holds for key in JUDGED)
        assert not holds or all(seen.values())
    if holds:
        assert not any(row["disagrees"] for row in found["equations"])
        level = found["levels"]["level"]
        for part in ("execution_ns", "plan_ns"):
            assert level["measured"][part] == pytest.approx(level["predicted"][part], rel=0.1)


@pytest.mark.parametrize(
    ("outcome", "missed", "to_do"),
    [
        ({"cause": "task done"}, 0, "nothing"),
        ({"cause": "time over", "faults": []}, 3, "nothing"),
        ({"cause": "task failed"}, 0, "rack report {}"),
        ({"cause": "time over", "faults": ["emergency stop"]}, 0, "rack report {}"),
    ],
)
def test_the_verdict_comes_first_and_tables_only_on_demand(
    record: Record, outcome: dict[str, Any], missed: int, to_do: str
) -> None:
    counts = {"missed": missed, "skipped": 2 * (missed > 0)}
    ended = {"kind": "outcome", "outcome": outcome, "tasks": {"lower": counts}}
    traces = {name: [Cycle(SETTLED + k, PLAIN) for k in range(40)] for name in ("lower", "upper")}
    folder = record(traces, *BUDGET, events=[ended]).folder
    done = rack("analyze", folder)
    assert (done.returncode, done.stderr) == (0, "")
    found = done.stdout.splitlines()
    lost = f"{missed} cycles missed, {counts['skipped']} skipped"
    assert found[0].startswith("small: all ")
    assert found[0].endswith(f" equations held; {outcome['cause']}, {lost}")
    assert found[1].startswith("tightest: ")
    assert found[1].endswith("% left")
    assert f"to do: {to_do.format(folder)}" in " ".join(line.strip() for line in found)
    assert found[-1] == f"{folder}/analysis.json"
    more = rack("analyze", folder, "--verbose").stdout.splitlines()
    assert more[:4] == found[:4]
    assert [any("Equations: " in line for line in lines) for lines in (found, more)] == [0, 1]


def test_differences_between_prediction_and_measurement_are_marked(record: Record) -> None:
    trace = [Cycle(SETTLED + k, PLAIN) for k in range(40)]
    trace[7] = Cycle(SETTLED + 7, LONG, flags=MISSED)
    recording = record({"lower": trace}, *BUDGET)
    analysis = Analysis.from_recording(recording)
    differing = {pair.equation for pair in analysis.pairs if pair.is_contradicted}
    assert differing >= {"3.1", "3.6", "response time"}
    assert not analysis.is_fulfilled
    found = text(analysis)
    first, *failed = found.partition("\nfailed in")[0].splitlines()
    assert first.startswith(f"small: {len(failed)} of ")
    # The worst is first, with value, bound and excess.
    assert failed[0] == "  lower, eq. 3.6: 0 < -0.3 ms fails"
    assert "  lower, eq. 3.1: 2.8 of 2.5 ms, 12% too much" in failed
    assert "not as predicted: lower 3.1" in found
    assert f"to do: rack check CONFIG --from {recording.folder} lists changes" in found
    levels = [line.split()[:5] for line in found.splitlines() if line.startswith("lower  ")]
    assert ["lower", "predicted", "2.5", "1", "0.4"] in levels
    assert ["lower", "measured", "2.5", "2.6", "0.2"] in levels
    assert "never ran: upper\nmade no plan: lower\n" in found


def test_a_rare_stall_fails_only_the_worst_cycle(record: Record) -> None:
    trace = [Cycle(SETTLED + k, LONG if k == 7 else PLAIN) for k in range(400)]
    recording = record({"lower": trace}, *BUDGET)
    analysis = Analysis.from_recording(recording)
    assert not analysis.is_fulfilled
    assert "failed in more than 1 of 100 cycles: none" in text(analysis)
    assert "to do: nothing about the config: it failed in single cycles" in brief(analysis)
    assert "to do: nothing\n" in brief(Analysis.from_recording(recording, 99.0))
    assert Analysis.from_recording(recording, 99.0).is_fulfilled


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
        # Three releases were skipped; before the cycle after it rows were lost, but no cycle was.
        (
            Cycle(SETTLED + 11, PLAIN, flags=SKIPPED | 3 << SKIPPED_SHIFT),
            "realtime",
            {"3.7": (10.0, 2.5)},
        ),
        (Cycle(SETTLED + 8, PLAIN, late=9.0), "lockstep", {}),
    ],
)
def test_the_equations_are_applied_to_the_worst_cycle(
    record: Record, last: Cycle, mode: str, broken: dict[str, tuple[float, float]]
) -> None:
    trace = [*(Cycle(SETTLED + k, PLAIN) for k in range(8)), last, Cycle(SETTLED + 15, PLAIN)]
    settings = (f"clock.mode={mode}", "timing.context_switch_ms=0.1")
    analysis = Analysis.from_recording(record({"lower": trace}, *settings))
    found = {
        pair.equation: (pair.measured.left / MS, pair.measured.right / MS)
        for pair in analysis.pairs
        if pair.measured is not None and pair.is_failed and pair.subject == "lower"
    }
    assert found == {name: pytest.approx(sides, abs=1e-6) for name, sides in broken.items()}


def test_a_late_level_whose_times_fit_is_not_referred_to_the_check(record: Record) -> None:
    late = [Cycle(SETTLED + k, PLAIN, late=3.0) for k in range(40)]
    analysis = Analysis.from_recording(record({"lower": late}, *BUDGET))
    assert not analysis.is_fulfilled
    assert "to do: nothing about the config: its levels' own times fit" in brief(analysis)
