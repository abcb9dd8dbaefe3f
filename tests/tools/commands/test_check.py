"""Tests `rack check` as a user runs it: tables, proposed changes and exit status."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from rack.boards.config import load, read_budgets
from rack.boards.config.files import list_names
from rack.tools.timing.judged_config import JudgedConfig
from tests.tools.command_line import rack, read_answer, read_refusal

FAILS = ("--set", "board.lower.budget={ process_ms = 0.5, plan_ms = 12.0 }")
FAILING = ("chimera/overload", "fig3", "fig4-overload")
"""Configs that show what does not fit."""
ALONE = ("--set", "board.lower.core=1", "--set", "board.lower.priority=80")


@pytest.fixture(autouse=True)
def two_cores() -> Iterator[None]:
    """Pretend that the machine has two cores, because the cheapest change depends on them."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[:2])
    yield
    os.sched_setaffinity(0, before)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in list_names() if name not in FAILING])
def test_a_shipped_rack_passes_its_own_check(name: str) -> None:
    done = rack("check", name, "--verbose")
    assert (done.returncode, done.stderr) == (0, "")
    assert "FAILS" not in done.stdout


def test_json_holds_everything_with_both_sides(small: Path) -> None:
    timing = read_answer("check", small, *FAILS, *ALONE, status=1)["timing"]
    assert (timing["holds"], timing["context_switch_ns"]) == (False, 100_000)
    verdict = next(v for v in timing["verdicts"] if v["equation"] == "3.8")
    found = [verdict[key] for key in ("subject", "unit", "sign", "holds")]
    assert found == ["lower", "ns", "<", False]
    assert [verdict[side] for side in ("left", "right", "margin")] == [3e6, 1.8e6, -1.2e6]
    times = ("cycle_ns", "residual_ns", "planning_ns", "slice_ns")
    assert [timing["levels"][0][time] for time in times] == [2.5e6, 2e6, 12e6, 10e6]
    response = next(r for r in timing["responses"] if r["task"] == "lower.planner")
    assert (response["deadline_ns"], response["holds"]) == (10_000_000, False)
    assert timing["loads"] == {"1": pytest.approx(0.7 / 2.5 + 12.2 / 10)}
    assert timing["repair"]["fits"]
    assert timing["repair"]["steps"][0][0]["settings"] == {"within_cycles": 7}


def test_a_fixed_config_loads_and_holds(small: Path, tmp_path: Path) -> None:
    done = rack("check", small, *FAILS, *ALONE, "--fix")
    assert done.returncode == 0
    assert "within_cycles 4 -> 7" in done.stderr
    fixed = tmp_path / "fixed.toml"
    fixed.write_text(done.stdout)
    config = load(fixed)
    assert config.board["lower"].within_cycles == 7
    assert JudgedConfig.judge(config).failures == ()
    document = read_answer("check", small, *FAILS, *ALONE, "--fix")
    assert (document["fits"], "within_cycles = 7" in document["config"]) == (True, True)
    # One that fits stays as it is.
    again = rack("check", fixed, "--fix")
    assert (again.returncode, again.stderr) == (0, "nothing to change\n")
    assert again.stdout == config.to_toml_text()


def test_no_config_is_printed_if_no_change_helps(small: Path) -> None:
    done = rack("check", small, "--set", "board.lower.budget.process_ms=100", "--fix")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("no change helps with 3.1 of lower")


@pytest.mark.slow
def test_budgets_come_from_an_earlier_run_and_are_in_a_fixed_config(
    small: Path, run: Path, tmp_path: Path
) -> None:
    done = rack("check", small, "--from", run, "--percentile", 90, "--json")
    timing = json.loads(done.stdout)["timing"]
    assert done.returncode == (0 if timing["holds"] else 1)
    levels = {level["board"]: level for level in timing["levels"]}
    assert all(0 < level["execution_ns"] < 1_000_000 for level in levels.values())
    assert levels["lower"]["plan_ns"] > 0
    assert levels["upper"]["plan_ns"] is None
    # A cycle this short leaves the measured planner nothing; whatever helps is judged by what was
    # measured.
    done = rack("check", small, "--from", run, "--percentile", 50, "--fix")
    assert done.returncode == 0, done.stderr
    fixed = tmp_path / "fixed.toml"
    fixed.write_text(done.stdout)
    assert set(read_budgets(load(fixed))) == {"upper", "lower"}
    assert rack("check", fixed).returncode == 0


def test_a_run_of_another_rack_is_refused_in_one_line(run: Path) -> None:
    why = "its boards are lower, upper, but those of 'fig2' are level"
    assert read_refusal(rack("check", "fig2", "--from", run)) == f"{run}: {why}"


@pytest.mark.slow
def test_a_static_schedule_is_a_table_of_its_distinct_frames() -> None:
    settings = ("--set", "schedule.major_ms=40", "--set", "board.even.budget.process_ms=3.1")
    done = rack("check", "cyclic", *settings, "--verbose")
    assert done.returncode == 1
    rows = {" ".join(line.split()) for line in done.stdout.splitlines()}
    assert {
        "static schedule, ms: 10 frames of 4, 4 ticks; every budget with two context switches:",
        "1 0, 2 ... 8 even 1 3.14 -0.14 end of frame FAILS",
        "1 1, 3 ... 9 fast 0 0.94 0.06 odd ok",
    } <= rows
    found = read_answer("check", "cyclic")["timing"]["schedule"]
    assert (found["minor_ms"], found["major_ms"]) == (4, 8)
    assert [(core["core"], core["frames"]) for core in found["cores"]] == [(1, [0]), (1, [1])]
    assert [place["board"] for place in found["cores"][1]["places"]] == ["fast", "odd"]


@pytest.mark.slow
def test_verbose_shows_the_motion_of_the_arm_without_new_torques() -> None:
    words = ("nasrem", "--set", "robot.patience_ms=10")
    printed = rack("check", *words, "--verbose").stdout.replace("\n  ", " ")
    (line,) = (line for line in printed.splitlines() if line.startswith("patience: "))
    assert "'servo' keeps its last torque for 10 ms (4 cycles; at most 10.0 ms)" in line
    assert "turn [19.2, 15.1, 24.0, 53.4, 50.9, 57.4] mrad, and all motors at full torque" in line
    (found,) = read_answer("check", *words)["patience"]
    assert [found[key] for key in ("board", "ms", "cycles", "energy_j")] == ["servo", 10, 4, 10.372]
