"""Verdicts: both sides of every equation for levels, tasks and cores, as calculated by hand."""

from __future__ import annotations

from math import inf

import pytest

from rack.boards.config import load
from rack.tools.timing.judged_config import JudgedConfig
from tests.tools.timing.conftest import Judge

MS = 1_000_000
LOOSE = ("board.lower.coupling=loose", "board.lower.planner_slot=4", "board.lower.planner_core=2")


def sides(
    judged: JudgedConfig, equation: str, subject: str
) -> list[tuple[float, str, float, bool]]:
    """Return both sides of an equation for a subject, in ms or as fractions."""
    found = [v for v in judged.verdicts if (v.equation, v.subject) == (equation, subject)]
    assert found, f"no {equation} of {subject}"
    scale = [MS if v.unit == "ns" else 1 for v in found]
    return [(v.left / s, v.sign, v.right / s, v.holds) for v, s in zip(found, scale, strict=True)]


SECOND = (
    "executor = 'two_levels:Lower', above = 'upper', reads = { plan = 'lower.plan' }, budget = {"
    " process_ms = 1 }"
)
JOINT = f"board.joint={{ slot = 9, core = 2, every = 16, {SECOND} }}"
"""Boards per joint, the second of which is slower than the level above."""
UNEVEN = "board.lower={ rate_hz = 57.142857142857146 }"
"""8 and 7 ticks: 15, and 6 of waiting going down, 7 going up; twice the longest is 16."""
GOAL = "timing.response_ms=35"
"""10 and 20 ms are 30, upwards 40 with the wait for the grid; R_max is half of the goal."""
LOCKED = "protocol.mailbox={ 'lower.plan' = 'lock' }"
SHARED = ("board.lower.core=0", "board.lower.within_cycles=2")


@pytest.mark.parametrize(
    ("settings", "equation", "subject", "expected"),
    [
        ((), "3.1", "lower", [(4.25, "<=", 10, True)]),
        ((), "3.4", "lower", [(3, "<", 20, True)]),  # R_max is the upper level's
        ((), "3.5", "lower", [(10, "=", 10, True)]),
        ((), "3.6", "lower", [(0, "<", 5.75, True)]),
        ((), "3.7", "lower", [(10, "=", 10, True)]),
        ((), "3.8", "lower", [(8.5 / 4, "<", 5.75 - 0.2, True)]),
        # t_executor-planner is C + U.
        ((), "3.9", "lower", [(3 + 1 + 0.75 + 0.2, "<", 10, True)]),
        ((), "3.10", "lower", [(0.75 / 10, "<=", 0.1, True)]),
        ((), "3.3", "system", [(30, "<=", 40, True)]),
        # Up, a status waits for the release of a level half as fast.
        ((), "3.2", "system", [(30, "<=", 40, True), (40, "<=", 40, True)]),
        ((UNEVEN,), "3.3", "system", [(37.5, "<=", 40, True)]),
        ((GOAL,), "3.2", "system", [(30, "<=", 35, True), (40, "<=", 35, False)]),
        ((GOAL,), "3.1", "upper", [(20, "<=", 17.5, False), (4, "<=", 20, True)]),
        ((GOAL,), "3.4", "lower", [(3, "<", 17.5, True)]),
        # A goal is simulated time, budgets are of the wall clock.
        (("timing.response_ms=40", "clock.speed=2"), "3.3", "system", [(15, "<=", 20, True)]),
        (("clock.speed=2",), "3.1", "lower", [(4.25, "<=", 5, True)]),
        # Every chain of levels is judged, and has one longest cycle.
        ((JOINT,), "3.3", "system, upper > lower", [(30, "<=", 40, True)]),
        ((JOINT,), "3.3", "system, upper > joint", [(60, "<=", 80, True)]),
        ((JOINT,), "3.4", "joint", [(1, "<", 40, True)]),
        # A loose planner has its slice.
        (LOOSE, "fig. 4", "lower", [(8.5, "<=", 40, True)]),
        # 8.7 with 4.45 of its executor every 10 and 4.2 of the upper level every 20: levels on one
        # core respond later though each equation holds.
        (SHARED, "3.8", "lower", [(8.5 / 2, "<", 5.55, True)]),
        (SHARED, "response time", "lower.planner", [(8.7 + 4 * 4.45 + 2 * 4.2, "<=", 20, False)]),
        # The clock takes 0.4 + 0.2 of its core every 2.5 ms: two ticks come while the upper level
        # computes 4.2.
        (("timing.clock_ms=0.4",), "response time", "upper", [(4.2 + 3 * 0.6, "<=", 20, True)]),
        (("timing.clock_ms=0.4",), "load", "core 0", [(0.6 / 2.5 + 4.2 / 20, "<=", 1, True)]),
        # A critical update blocks the executor.
        ((), "response time", "lower", [(4.45, "<=", 10, True)]),
        ((LOCKED,), "response time", "lower", [(4.95, "<=", 10, True)]),
    ],
)
def test_each_equation_shows_both_sides(
    judge: Judge,
    settings: tuple[str, ...],
    equation: str,
    subject: str,
    expected: list[tuple[float, str, float, bool]],
) -> None:
    assert sides(judge(*settings), equation, subject) == [
        (pytest.approx(left), sign, pytest.approx(right), holds)
        for left, sign, right, holds in expected
    ]


LATE_PLANS = {("response time", "lower.planner"), ("load", "core 1")}


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ((), set()),
        ((UNEVEN,), {("3.2", "system")}),
        (("timing.response_ms=29",), {("3.1", "upper"), ("3.2", "system"), ("3.3", "system")}),
        # 8.5 / 1 < 5.55; its response 8.7 + 1 * 4.45 > 10.
        (("board.lower.within_cycles=1",), {("3.8", "lower"), *LATE_PLANS}),
        # C + U = 1.25 of 10.
        (("board.lower.budget.update_ms=1.0",), {("3.10", "lower")}),
        (("board.lower.budget.plan_within_ms=39",), {("plan within", "lower")}),
        # 9 + 1.25 is more than the cycle and leaves no time for planning.
        (
            ("board.lower.budget.process_ms=9",),
            {(one, "lower") for one in ("3.1", "3.5", "3.6", "3.8", "3.9", "response time")}
            | LATE_PLANS,
        ),
        # The cycle is completely full. It fits, but the residual of 0 leaves no time for switches.
        (
            ("board.lower.budget.process_ms=8.75", "board.lower.planner_priority=0"),
            {(one, "lower") for one in ("3.6", "3.8", "3.9", "response time")} | LATE_PLANS,
        ),
        (SHARED, {("response time", "lower.planner"), ("load", "core 0")}),
    ],
)
def test_a_rack_that_does_not_fit_fails_exactly_the_expected_equations(
    judge: Judge, settings: tuple[str, ...], expected: set[tuple[str, str]]
) -> None:
    failures = judge(*settings).failures
    assert {(verdict.equation, verdict.subject) for verdict in failures} == expected


@pytest.mark.parametrize(
    "settings", [LOOSE, ("board.lower.budget.plan_ms=0", "board.lower.budget.update_ms=0")]
)
def test_equations_of_a_tight_planner_do_not_apply_to_a_loose_or_unknown_one(
    judge: Judge, settings: tuple[str, ...]
) -> None:
    judged = judge(*settings)
    found = {v.equation for v in judged.verdicts if v.subject == "lower"}
    assert not found & {"3.8", "3.9", "3.10"}
    assert (judged.timing.levels["lower"].within_cycles is None) == (settings != LOOSE)


def test_a_response_without_bound_is_none_as_plain_data(judge: Judge) -> None:
    judged = judge("board.lower.budget.process_ms=9")
    (verdict,) = (v for v in judged.failures if v.subject == "lower.planner")
    assert (verdict.left, verdict.margin) == (inf, -inf)
    assert (verdict.to_document()["left"], verdict.to_document()["margin"]) == (None, None)


@pytest.mark.parametrize(
    ("rack", "expected"),
    [
        ("fig2", set()),
        ("fig3", {"3.8", "response time", "load"}),
        ("fig4", set()),
        ("fig4-overload", {"3.1", "3.5", "3.6", "response time", "load"}),
    ],
)
def test_the_papers_figures_are_predicted_as_the_paper_has_them(
    rack: str, expected: set[str]
) -> None:
    assert {v.equation for v in JudgedConfig.judge(load(rack)).failures} == expected
