"""`rack check` as a user runs it: its tables, the changes that it proposes, and its exit status."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from rack.boards.config import budgets, load
from rack.boards.config.files import names
from rack.levels.timing.forecast import Forecast
from rack.tools.console.tables import render_text
from rack.tools.timing.inventory import inventory, inventory_blocks
from rack.tools.timing.judged_config import JudgedConfig
from rack.tools.timing.tables import forecast_blocks
from tests.shared_runs import small_run
from tests.tools.command_line import rack

FITS = (
    "--set",
    "board.lower.budget={ read_ms = 0.1, process_ms = 0.5, plan_ms = 2.0, update_ms = 0.1 }",
)
FAILS = ("--set", "board.lower.budget={ process_ms = 0.5, plan_ms = 12.0 }")
FAILING = ("fig3", "fig4-overload")
"""Configs that show what does not fit."""
ALONE = ("--set", "board.lower.core=1", "--set", "board.lower.priority=80")


@pytest.fixture(autouse=True)
def two_cores() -> Iterator[None]:
    """Let every machine have two cores: the cheapest change depends on them."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[:2])
    yield
    os.sched_setaffinity(0, before)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run of the small rack."""
    return small_run(tmp_path_factory)


def check(*words: object) -> subprocess.CompletedProcess[str]:
    return rack("check", *words, *(() if "--json" in words else ("--verbose",)))


def failures(done: subprocess.CompletedProcess[str]) -> list[str]:
    return [line for line in done.stdout.splitlines() if "FAILS" in line]


def test_a_rack_that_fits_ends_with_status_0(small: Path) -> None:
    done = check(small, *FITS, *ALONE)
    assert (done.returncode, failures(done)) == (0, [])
    assert "to make it fit" not in done.stdout
    assert "'upper' (no budget)" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in names() if name not in FAILING])
def test_a_shipped_rack_passes_its_own_check(name: str) -> None:
    done = check(name)
    assert (done.returncode, failures(done), done.stderr) == (0, [], "")


@pytest.mark.parametrize("name", FAILING)
def test_the_figures_of_overload_fail_their_check(name: str) -> None:
    done = check(name)
    assert done.returncode == 1
    assert failures(done)


def test_a_rack_that_fails_shows_where_and_which_changes_help(small: Path) -> None:
    done = check(small, *FAILS, *ALONE)
    assert done.returncode == 1
    # First what fails, then the tables with the rest.
    assert {line.split()[0] for line in failures(done)} == {"3.8", "1", "load:", "response", "load"}
    assert "  board 'lower': within_cycles 4 -> 7 (a plan every 17.5 ms)" in done.stdout


def test_a_rack_without_budgets_has_nothing_to_fail(small: Path) -> None:
    done = check(small)
    assert done.returncode == 0
    assert "fits, as far as is known: no board has a budget" in done.stdout


@pytest.mark.parametrize("width", [80, 120])
def test_what_a_check_shows_fits_the_terminal(width: int) -> None:
    found = load("nasrem")
    judged = JudgedConfig.of(found)
    lines = [*render_text(inventory_blocks(inventory(found, judged.layout, [])), width)]
    lines += render_text(forecast_blocks(Forecast.of(judged.timing)), width)
    # Other text is wrapped when it is printed.
    rows = [line for line in lines if "  " in line.strip()]
    assert len(rows) > 50
    assert max(map(len, rows)) <= width


def test_json_holds_everything_with_both_sides(small: Path) -> None:
    done = check(small, *FAILS, *ALONE, "--json")
    timing = json.loads(done.stdout)["timing"]
    assert done.returncode == 1
    assert not timing["holds"]
    verdict = next(v for v in timing["verdicts"] if v["equation"] == "3.8")
    assert (verdict["left"], verdict["sign"], verdict["right"]) == (3e6, "<", 1.8e6)
    assert (verdict["margin"], verdict["holds"], verdict["subject"], verdict["unit"]) == (
        -1.2e6,
        False,
        "lower",
        "ns",
    )
    level = timing["levels"][0]
    assert (level["cycle_ns"], level["residual_ns"], level["planning_ns"], level["slice_ns"]) == (
        2_500_000,
        2_000_000,
        12_000_000,
        10_000_000,
    )
    response = next(r for r in timing["responses"] if r["task"] == "lower.planner")
    assert response["deadline_ns"] == 10_000_000
    assert not response["holds"]
    assert timing["loads"] == {"1": pytest.approx(0.7 / 2.5 + 12.2 / 10)}
    assert timing["context_switch_ns"] == 100_000
    assert timing["repair"]["fits"]
    assert timing["repair"]["steps"][0][0]["settings"] == {"within_cycles": 7}


def test_a_fixed_config_loads_and_holds(small: Path, tmp_path: Path) -> None:
    done = check(small, *FAILS, *ALONE, "--fix")
    assert done.returncode == 0
    assert "within_cycles 4 -> 7" in done.stderr
    fixed = tmp_path / "fixed.toml"
    fixed.write_text(done.stdout)
    config = load(fixed)
    assert config.board["lower"].within_cycles == 7
    assert JudgedConfig.of(config).failing == ()
    assert check(fixed).returncode == 0


def test_a_fix_is_json_too(small: Path) -> None:
    document = json.loads(check(small, *FAILS, *ALONE, "--fix", "--json").stdout)
    assert document["fits"]
    assert "within_cycles = 7" in document["config"]


def test_where_nothing_helps_no_config_is_printed(small: Path) -> None:
    done = check(small, "--set", "board.lower.budget.process_ms=100", "--fix")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("no change helps with 3.1 of lower")


def test_a_rack_that_fits_is_fixed_as_it_is(small: Path) -> None:
    done = check(small, *FITS, *ALONE, "--fix")
    assert (done.returncode, done.stderr) == (0, "nothing to change\n")
    assert done.stdout == load(small, [*FITS[1:], *ALONE[1::2]]).text()


@pytest.mark.slow
def test_budgets_come_from_an_earlier_run(small: Path, recorded: Path) -> None:
    done = check(small, "--from", recorded, "--percentile", 90, "--json")
    timing = json.loads(done.stdout)["timing"]
    assert done.returncode == (0 if timing["holds"] else 1)
    levels = {level["board"]: level for level in timing["levels"]}
    assert set(levels) == {"upper", "lower"}
    assert all(0 < level["execution_ns"] < 1_000_000 for level in levels.values())
    assert levels["lower"]["plan_ns"] > 0
    assert levels["upper"]["plan_ns"] is None


@pytest.mark.slow
def test_a_fix_carries_the_measured_budgets(small: Path, recorded: Path, tmp_path: Path) -> None:
    # A cycle this short leaves the measured planner nothing; whatever helps is judged by what was
    # measured.
    done = check(small, "--from", recorded, "--percentile", 50, "--fix")
    assert done.returncode == 0, done.stderr
    fixed = tmp_path / "fixed.toml"
    fixed.write_text(done.stdout)
    assert set(budgets(load(fixed))) == {"upper", "lower"}
    assert check(fixed).returncode == 0


def test_a_run_of_another_rack_is_refused_in_one_line(recorded: Path) -> None:
    done = check("fig2", "--from", recorded)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"{recorded}: a run of other boards: lower, upper; 'fig2' has level\n"


def test_a_folder_that_is_no_run_is_refused_in_one_line(small: Path, tmp_path: Path) -> None:
    done = check(small, "--from", tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1


def test_a_budget_of_a_planner_that_is_not_there_is_a_mistake(small: Path) -> None:
    done = check(small, "--set", "board.upper.budget.plan_ms=6")
    assert done.returncode == 2
    assert (
        done.stderr
        == "board.upper.budget.plan_ms = 6.0: the board has no planner; remove it, or add one\n"
    )


@pytest.mark.slow
def test_a_static_schedule_is_a_table_of_its_distinct_frames() -> None:
    done = check(
        "cyclic", "--set", "schedule.major_ms=40", "--set", "board.even.budget.process_ms=3.1"
    )
    rows = [line.split() for line in done.stdout.splitlines()]
    assert (
        "static schedule, ms: 10 frames of 4, 4 ticks; every budget with two context switches:"
        in done.stdout
    )
    assert [
        "1",
        "0,",
        "2",
        "...",
        "8",
        "even",
        "1",
        "3.14",
        "-0.14",
        "end",
        "of",
        "frame",
        "FAILS",
    ] in rows
    assert ["1", "1,", "3", "...", "9", "fast", "0", "0.94", "0.06", "odd", "ok"] in rows
    assert done.returncode == 1


def test_the_static_schedule_is_in_the_json_document() -> None:
    found = json.loads(check("cyclic", "--json").stdout)["timing"]["schedule"]
    assert (found["minor_ms"], found["major_ms"]) == (4, 8)
    assert [(core["core"], core["frames"]) for core in found["cores"]] == [(1, [0]), (1, [1])]
    assert [place["board"] for place in found["cores"][1]["places"]] == ["fast", "odd"]


@pytest.mark.slow
def test_verbose_shows_what_the_arm_does_while_no_torque_comes() -> None:
    words = ("nasrem", "--set", "robot.patience_ms=10")
    (line,) = (line for line in check(*words).stdout.splitlines() if line.startswith("patience: "))
    assert line.startswith(
        "patience: 'servo' goes on with its last torque for 10 ms (4 cycles; permitted: 10.0 ms). "
    )
    assert (
        "turn [19.2, 15.1, 24.0, 53.4, 50.9, 57.4] mrad, and all motors at full torque put in"
        " 10.372 J" in line
    )
    assert "patience" not in rack("check", *words).stdout
    (found,) = json.loads(check(*words, "--json").stdout)["patience"]
    assert (found["board"], found["ms"], found["cycles"], found["energy_j"]) == (
        "servo",
        10.0,
        4,
        10.372,
    )


@pytest.mark.slow
def test_verbose_shows_what_the_monitors_stand_for_an_arm_of_ones_own_more() -> None:
    hardware = "configs/examples/own-hardware/hardware.toml"
    (own,) = json.loads(check(hardware, "--json").stdout)["monitors"]
    assert own == {
        "board": "servo",
        "position_mrad": [0.375] * 7,
        "velocity_mrad_s": [3.5] * 7,
        "jitter_ms": 0.125,
    }
    (simulated,) = json.loads(check("k1607", "--json").stdout)["monitors"]
    assert (simulated["position_mrad"], simulated["jitter_ms"]) == ([0.025] * 7, 0.008)
    lines = rack("check", hardware, "--verbose").stdout.splitlines()
    assert sum(line.startswith("monitors: 'servo' takes samples for good") for line in lines) == 1
