"""The first lines of a check: what they say of a rack that fits, and of one that does not."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.tools.command_line import rack

BUDGET = "board.lower.budget={ read_ms = 0.1, process_ms = 0.5, plan_ms = 2.0, update_ms = 0.1 }"
FAILS = "board.lower.budget={ process_ms = 0.5, plan_ms = 12.0 }"
ALONE = ("--set", "board.lower.core=1", "--set", "board.lower.priority=80")
MORE = "--verbose shows every task, mailbox and equation"


def lines(*words: object, status: int = 0) -> list[str]:
    """Return what a check prints."""
    done = rack("check", *words)
    assert (done.returncode, done.stderr) == (status, "")
    return done.stdout.splitlines()


@pytest.mark.slow
def test_a_rack_that_fits_is_five_lines() -> None:
    found = lines("nasrem")
    starts = ("rack nasrem: ", "fits: all ", "tightest: ", "response: ", "arm: ", "to do: nothing")
    assert [line[: len(start)] for line, start in zip(found, starts, strict=False)] == [*starts]
    assert found[3] == "response: a command down 1282.5 ms, a status up 2280 ms"
    assert found[-1] == MORE
    assert len(found) <= 8


def test_the_tightest_is_named_with_both_sides(small: Path) -> None:
    found = lines(small, "--set", BUDGET, *ALONE)
    (tightest,) = [line for line in found if line.startswith("tightest: ")]
    assert tightest.endswith("% left")
    assert " of " in tightest
    assert not [line for line in found if line.startswith("arm: ")]


def test_a_rack_that_does_not_fit_shows_what_fails_and_what_helps(small: Path) -> None:
    found = lines(small, "--set", FAILS, *ALONE, status=1)
    assert found[1].startswith("does not fit: 3 of ")
    assert found[2].endswith("% too much")
    failing = [line for line in found if "FAILS" in line]
    assert [line.split()[0] for line in failing] == ["3.8", "response", "load"]
    assert "  board 'lower': within_cycles 4 -> 7 (a plan every 17.5 ms)" in found
    assert "to do: nothing" not in found
    assert found[-1] == MORE


def test_a_rack_without_budgets_is_not_said_to_fit(small: Path) -> None:
    found = lines(small)
    assert found[1].startswith(("fits, as far as is known", "fits: all "))
    assert any("not counted" in line for line in found)


def test_the_rest_comes_on_demand(small: Path) -> None:
    few = lines(small, "--set", BUDGET, *ALONE)
    many = lines(small, "--set", BUDGET, *ALONE, "--verbose")
    assert many[: len(few) - 1] == few[:-1]
    assert any(line.startswith("segment: ") for line in many)
    assert not any(line.startswith("segment: ") for line in few)
