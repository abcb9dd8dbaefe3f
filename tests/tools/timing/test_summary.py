"""The first lines of a check, for a rack that fits and for one that does not."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from rack.backplane.mailbox.inbox import InterruptSource
from rack.boards.config import load
from rack.boards.timing.interrupts import InboxTiming
from rack.boards.timing.verdicts import INBOX, evaluate_rack
from rack.tools.timing.judged_config import JudgedConfig
from rack.tools.timing.summary import find_tightest
from tests.tools.command_line import rack, read_answer

BUDGET = "board.lower.budget={ read_ms = 0.1, process_ms = 0.5, plan_ms = 2.0, update_ms = 0.1 }"
UPPER = "board.upper.budget={ process_ms = 0.1 }"
FAILS = "board.lower.budget={ process_ms = 0.5, plan_ms = 12.0 }"
ALONE = ("--set", "board.lower.core=1", "--set", "board.lower.priority=80")
MORE = "--verbose shows every task, mailbox and equation"


def check_lines(*words: object, status: int = 0) -> list[str]:
    done = rack("check", *words)
    assert (done.returncode, done.stderr) == (status, "")
    return done.stdout.splitlines()


@pytest.mark.slow
def test_the_verdict_of_a_rack_that_fits_is_followed_by_a_bar_per_core() -> None:
    found = check_lines("nasrem")
    starts = ("fits: all ", "rack nasrem: ", "core 0 ", "core 1 ", "tightest: ", "response: ")
    assert [line[: len(start)] for line, start in zip(found, starts, strict=False)] == [*starts]
    bar = "core 1  [###############.]  98.6%"
    assert found[3] == f"{bar}  servo 51%, task.planner 43%, servo.planner 5%"
    assert found[4] == "tightest: core 1, load: 0.986 of 1, 1% left"
    assert found[5] == "response: a command down 1282.5 ms, a status up 2280 ms"
    assert found[-1] == MORE
    assert len(found) <= 10


def test_a_rack_that_does_not_fit_shows_failures_and_helpful_changes(small: Path) -> None:
    found = check_lines(small, "--set", FAILS, *ALONE, status=1)
    assert found[0].startswith("does not fit: 3 of ")
    # A bar ends at 100 %.
    assert "core 1  [################] 150.0%  lower.planner 122%, lower 28%" in found
    assert any(line.endswith("% too much") for line in found)
    failing = [line for line in found if "FAILS" in line]
    assert [line.split()[0] for line in failing] == ["3.8", "response", "load"]
    assert "      board 'lower': within_cycles 4 -> 7, a plan every 17.5 ms" in found
    assert found[-1] == MORE


@pytest.mark.parametrize(
    "words",
    [
        ("fig3",),
        ("fig4-overload",),
        # Its rate is in Hz, which excludes a period in ticks.
        ("nasrem", "--set", "board.primitive.budget.process_ms=15"),
        # Two boards need a change, and one of them another core.
        pytest.param(
            ("nasrem", "--set", "board.world.budget.process_ms=21", "--set", "board.servo.core=0"),
            marks=pytest.mark.thorough,
        ),
    ],
)
def test_each_printed_fix_makes_the_rack_fit_when_it_is_pasted(words: tuple[str, ...]) -> None:
    printed = "\n".join(check_lines(*words, status=1)).replace(" \\\n", "")
    fixes = [line for line in printed.splitlines() if line.startswith("  --set ")]
    assert 1 <= len(fixes) <= 3
    for fix in fixes:
        done = rack("check", *words, *shlex.split(fix))
        assert (done.returncode, done.stdout[:4]) == (0, "fits"), fix
    timing = read_answer("check", *words, status=1)["timing"]
    assert [shlex.split(fix)[1::2] for fix in fixes] == timing["repair"]["fixes"]


def test_the_verdict_names_everything_that_was_not_counted(small: Path) -> None:
    found = check_lines(small, "--set", BUDGET, *ALONE)
    clock = "'clock' (timing.clock_ms is 0; --set timing.clock_ms=0.1 counts 0.1 ms)"
    assert " ".join(map(str.strip, found[:2])) == (
        f"fits, but 2 not counted: {clock}, 'upper' (no budget)"
    )
    assert found[2].startswith("all ")
    assert any(line.endswith("upper not counted") for line in found)
    counted = ("--set", UPPER, "--set", "timing.clock_ms=0.01")
    assert check_lines(small, "--set", BUDGET, *ALONE, *counted)[0].startswith("fits: all ")
    failed, *left_out = check_lines(small, "--set", FAILS, *ALONE, status=1)[:3]
    assert failed.endswith("equations and bounds fail")
    assert f"not counted: {clock}, 'upper' (no budget)" in " ".join(map(str.strip, left_out))
    unknown = check_lines(small)[0]
    assert unknown == "not known whether it fits: no board has a budget"


def test_the_document_names_everything_that_was_not_counted(small: Path) -> None:
    idle = BUDGET.replace("plan_ms = 2.0", "plan_ms = 0.0")
    for settings, fits, names in (
        ((BUDGET,), None, ["clock", "upper"]),
        ((BUDGET, UPPER, "timing.clock_ms=0.01"), True, []),
        ((FAILS, UPPER), False, ["clock"]),
        ((idle, UPPER), None, ["clock", "lower.planner"]),
    ):
        words = [word for setting in settings for word in ("--set", setting)]
        timing = read_answer("check", small, *words, *ALONE, status=int(fits is False))["timing"]
        assert (timing["fits"], list(timing["uncounted"])) == (fits, names)


def test_host_boards_are_named_as_not_counted() -> None:
    found = read_answer("check", "ibm")["timing"]["uncounted"]
    hosts = load("ibm").host
    assert hosts
    assert hosts.keys() <= found.keys()


@pytest.mark.slow
def test_the_command_in_the_verdict_measures_what_was_missing(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    settings = ("--set", "clock.mode=lockstep", "--set", "timing.clock_ms=0.01")
    printed = "\n".join(check_lines(small, *settings)).replace("\\\n", "")
    lines = (line for line in printed.splitlines() if line.startswith("  rack "))
    first, second = map(shlex.split, lines)
    assert rack(*first[1:]).returncode == 0
    done = rack(*second[1:])
    # On a busy machine the measured times may not fit.
    assert done.returncode in (0, 1)
    assert done.stdout
    assert "no budget" not in done.stdout


def test_a_planner_that_never_finishes_is_described_in_a_sentence(small: Path) -> None:
    overload = "board.lower.budget={ process_ms = 2.0, plan_ms = 1e6 }"
    found = check_lines(small, "--set", overload, *ALONE, "--verbose", status=1)
    never = "tightest: planner 'lower.planner' never finishes: core 1 is over"
    assert any(line.startswith(never) for line in found)
    assert not [line for line in found if re.search(r"\binf\b|inf%", line)]


def test_interrupts_that_never_end_are_described_in_a_sentence() -> None:
    source = InterruptSource(1_000, 2_000)
    inbox = InboxTiming("low", ("up.status",), (source,), 4, 1_000, 0)
    timing = JudgedConfig.judge(load("fig2")).timing
    board = next(iter(timing.boards))
    timing = replace(timing, inboxes={board: replace(inbox, task=board)})
    (found,) = [verdict for verdict in evaluate_rack(timing) if verdict.equation == INBOX]
    assert list(find_tightest([found])) == [
        "tightest: interrupts of 'level' come faster than it serves them (load 2)"
    ]
