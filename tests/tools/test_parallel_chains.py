"""A board a joint, as a user sees it: one line for all joints, and the response of all chains
measured."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rack.tools.report.report import write_report
from tests.boards.commanded_racks import commands
from tests.boards.vector_racks import JOINTED, NAMES
from tests.shared_runs import run_text
from tests.tools.command_line import rack, read_answer

TOGETHER = "path > joint1 ... joint3 > arm"


@pytest.fixture
def jointed(write: Callable[[str, str], Path]) -> Path:
    """The rack as a file."""
    return write("jointed.toml", JOINTED)


def test_a_check_has_one_line_for_boards_with_equal_figures(jointed: Path) -> None:
    done = rack("check", jointed, "--verbose")
    assert done.returncode == 0, done.stdout
    lines = done.stdout.splitlines()
    assert f"system response, {TOGETHER}:" in done.stdout
    assert [line.split()[:4] for line in lines if line.startswith("3.1")] == [
        ["3.1", "path", "0.7", "<="],
        ["3.1", "joint1", "...", "joint3"],
        ["3.1", "arm", "0.45", "<="],
    ]
    assert sum(line.startswith("3.3") for line in lines) == 1
    found = read_answer("check", jointed)["timing"]["verdicts"]
    subjects = {verdict["subject"] for verdict in found if verdict["equation"] == "3.1"}
    assert subjects == {"path", *NAMES, "arm"}


def test_a_joint_that_does_not_fit_is_repaired_without_the_others(jointed: Path) -> None:
    found = read_answer("check", jointed, "--fix", "--set", "board.joint2.budget.process_ms=2.0")
    assert [step[0]["board"] for step in found["steps"]] == ["joint2", "arm"]


@pytest.mark.slow
def test_the_response_is_measured_along_every_chain(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    # In lockstep, while an operator holds the highest level for a while.
    held = (("hold", 101), ("resume", 160))
    given = (f"level = 'path', what = '{what}', tick = {tick}" for what, tick in held)
    report, text = write_report(run_text(tmp_path_factory, JOINTED, 0.6, commands(*given)))
    response = report["system_response"]
    assert (response["levels"], response["others"]) == (["path", "joint1 ... joint3", "arm"], [])
    # 20 + 2.5 + 2.5 ms down; up, a status waits for up to 7 ticks more.
    assert [response[way]["measured_ms"]["max"] for way in ("command", "status")] == [25.0, 42.5]
    assert [response[way]["holds"] for way in ("command", "status")] == [True, True]
    assert "| command, " in text
