"""The first lines of a check, for a rack that fits and for one that does not."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from rack.backplane.mailbox.inbox import InterruptSource
from rack.boards.config import load
from rack.boards.timing.forecast import Forecast
from rack.boards.timing.interrupts import InboxTiming
from rack.boards.timing.verdicts import INBOX, evaluate_rack
from rack.tools.timing.judged_config import JudgedConfig
from rack.tools.timing.summary import find_tightest
from tests.tools.command_line import rack

BUDGET = "board.lower.budget={ read_ms = 0.1, process_ms = 0.5, plan_ms = 2.0, update_ms = 0.1 }"
UPPER = "board.upper.budget={ process_ms = 0.1 }"
FAILS = "board.lower.budget={ process_ms = 0.5, plan_ms = 12.0 }"
ALONE = ("--set", "board.lower.core=1", "--set", "board.lower.priority=80")
MORE = "--verbose shows every task, mailbox and equation"


def check_lines(*words: object, status: int = 0) -> list[str]:
    """Return the lines that a check prints."""
    done = rack("check", *words)
    assert (done.returncode, done.stderr) == (status, "")
    return done.stdout.splitlines()


@pytest.mark.slow
def test_the_summary_of_a_rack_that_fits_has_five_lines() -> None:
    found = check_lines("nasrem")
    starts = ("rack nasrem: ", "fits: all ", "tightest: ", "response: ", "arm: ", "to do: nothing")
    assert [line[: len(start)] for line, start in zip(found, starts, strict=False)] == [*starts]
    assert found[3] == "response: a command down 1282.5 ms, a status up 2280 ms"
    assert found[-1] == MORE
    assert len(found) <= 8


def test_a_rack_that_does_not_fit_shows_failures_and_helpful_changes(small: Path) -> None:
    found = check_lines(small, "--set", FAILS, *ALONE, status=1)
    assert found[1].startswith("does not fit: 3 of ")
    assert found[2].endswith("% too much")
    failing = [line for line in found if "FAILS" in line]
    assert [line.split()[0] for line in failing] == ["3.8", "response", "load"]
    assert "  board 'lower': within_cycles 4 -> 7 (a plan every 17.5 ms)" in found
    assert "to do: nothing" not in found
    assert found[-1] == MORE


def test_the_verdict_names_everything_that_was_not_counted(small: Path) -> None:
    found = check_lines(small, "--set", BUDGET, *ALONE)
    clock = "'clock' (timing.clock_ms is 0; --set timing.clock_ms=0.1 counts 0.1 ms)"
    assert found[1].startswith(f"fits, without {clock}, 'upper' (no budget): measure it by: ")
    assert found[2].startswith("all ")
    assert "to do: nothing" not in found
    counted = ("--set", UPPER, "--set", "timing.clock_ms=0.01")
    assert check_lines(small, "--set", BUDGET, *ALONE, *counted)[1].startswith("fits: all ")
    left_out = check_lines(small, "--set", FAILS, *ALONE, status=1)[1]
    assert f"equations and bounds fail; not counted: {clock}, 'upper' (no budget)" in left_out


def test_the_document_names_everything_that_was_not_counted(small: Path) -> None:
    idle = BUDGET.replace("plan_ms = 2.0", "plan_ms = 0.0")
    for settings, fits, names in (
        ((BUDGET,), None, ["clock", "upper"]),
        ((BUDGET, UPPER, "timing.clock_ms=0.01"), True, []),
        ((FAILS, UPPER), False, ["clock"]),
        ((idle, UPPER), None, ["clock", "lower.planner"]),
    ):
        words = [word for setting in settings for word in ("--set", setting)]
        printed = check_lines(small, *words, *ALONE, "--json", status=int(fits is False))
        timing = json.loads("\n".join(printed))["timing"]
        assert (timing["fits"], list(timing["uncounted"])) == (fits, names)


def test_host_boards_are_named_as_not_counted() -> None:
    judged = JudgedConfig.judge(load("ibm"))
    found = Forecast.from_rack(judged.timing, hosts=judged.config.host).uncounted
    assert judged.config.host
    assert judged.config.host.keys() <= found.keys()


@pytest.mark.slow
def test_the_command_in_the_verdict_measures_what_was_missing(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    settings = ("--set", "clock.mode=lockstep", "--set", "timing.clock_ms=0.01")
    command = check_lines(small, *settings)[1].partition("by: ")[2]
    first, second = (shlex.split(part) for part in command.split("; "))
    assert rack(*first[1:]).returncode == 0
    assert "no budget" not in "\n".join(check_lines(*second[2:]))


def test_a_planner_that_never_finishes_is_described_in_a_sentence(small: Path) -> None:
    overload = "board.lower.budget={ process_ms = 2.0, plan_ms = 1e6 }"
    found = check_lines(small, "--set", overload, *ALONE, "--verbose", status=1)
    assert found[2].startswith("tightest: planner 'lower.planner' never finishes: core 1 is over")
    assert not [line for line in found if re.search(r"\binf\b|inf%", line)]


def test_interrupts_that_never_end_are_described_in_a_sentence() -> None:
    inbox = InboxTiming("low", ("up.status",), (InterruptSource(1_000, 2_000),), 4)
    timing = replace(JudgedConfig.judge(load("fig2")).timing, inboxes={"low": inbox})
    (found,) = [verdict for verdict in evaluate_rack(timing) if verdict.equation == INBOX]
    assert list(find_tightest([found])) == [
        "tightest: interrupts of 'low' come faster than it serves them (load 2)"
    ]
