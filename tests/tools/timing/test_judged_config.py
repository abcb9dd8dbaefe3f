"""Verdicts: every equation with both sides, on levels, tasks and cores, against numbers worked out
by hand."""

from __future__ import annotations

from math import inf

import pytest

from rack.boards.config import load
from rack.levels.timing.verdicts import EquationVerdict
from rack.tools.timing.judged_config import JudgedConfig
from tests.tools.timing.conftest import Judge

MS = 1_000_000
LOOSE = ("board.lower.coupling=loose", "board.lower.planner_slot=4", "board.lower.planner_core=2")


def sides(
    judged: JudgedConfig, equation: str, subject: str
) -> list[tuple[float, str, float, bool]]:
    """Return both sides in ms, or as shares, of what an equation says of a subject."""
    found = [v for v in judged.verdicts if (v.equation, v.subject) == (equation, subject)]
    assert found, f"no {equation} of {subject}"
    scale = [MS if v.unit == "ns" else 1 for v in found]
    return [(v.left / s, v.sign, v.right / s, v.holds) for v, s in zip(found, scale, strict=True)]


def failing(judged: JudgedConfig) -> set[tuple[str, str]]:
    return {(verdict.equation, verdict.subject) for verdict in judged.failing}


@pytest.mark.parametrize(
    ("equation", "left", "sign", "right"),
    [
        ("3.1", 4.25, "<=", 10),
        ("3.4", 3, "<", 20),  # R_max is the upper level's
        ("3.5", 10, "=", 10),
        ("3.6", 0, "<", 5.75),
        ("3.7", 10, "=", 10),
        ("3.8", 8.5 / 4, "<", 5.75 - 0.2),
        ("3.9", 3 + 1 + 0.75 + 0.2, "<", 10),  # t_executor-planner is C + U
        ("3.10", 0.75 / 10, "<=", 0.1),
    ],
)
def test_each_equation_shows_both_sides_of_a_tight_level(
    judge: Judge, equation: str, left: float, sign: str, right: float
) -> None:
    assert sides(judge(), equation, "lower") == [
        (pytest.approx(left), sign, pytest.approx(right), True)
    ]


def test_the_system_responds_by_its_cycles_and_on_the_grid(judge: Judge) -> None:
    judged = judge()
    assert sides(judged, "3.3", "system") == [(30, "<=", 40, True)]
    # Up, a status waits for the release of a level half as fast.
    assert sides(judged, "3.2", "system") == [(30, "<=", 40, True), (40, "<=", 40, True)]


def test_cycles_that_do_not_divide_each_other_can_break_the_bound_on_the_grid(judge: Judge) -> None:
    # 8 and 7 ticks: 15, and 6 of waiting going down, 7 going up; twice the longest is 16.
    judged = judge("board.lower={ rate_hz = 57.142857142857146 }")
    assert ("3.2", "system") in failing(judged)
    assert sides(judged, "3.3", "system") == [(37.5, "<=", 40, True)]


def test_a_goal_for_the_response_is_what_the_cycles_are_held_against(judge: Judge) -> None:
    # 10 and 20 ms are 30, upwards 40 with the wait for the grid; R_max is half of the goal.
    judged = judge("timing.response_ms=35")
    assert sides(judged, "3.3", "system") == [(30, "<=", 35, True)]
    assert sides(judged, "3.2", "system") == [(30, "<=", 35, True), (40, "<=", 35, False)]
    assert sides(judged, "3.1", "upper") == [(20, "<=", 17.5, False), (4, "<=", 20, True)]
    assert sides(judged, "3.1", "lower")[0] == (10, "<=", 17.5, True)
    assert sides(judged, "3.4", "lower") == [(3, "<", 17.5, True)]
    assert failing(judge("timing.response_ms=29")) == {
        ("3.1", "upper"),
        ("3.2", "system"),
        ("3.3", "system"),
    }
    assert failing(judge("timing.response_ms=40")) == set()


def test_a_goal_is_simulated_time(judge: Judge) -> None:
    assert sides(judge("timing.response_ms=40", "clock.speed=2"), "3.3", "system") == [
        (15, "<=", 20, True)
    ]


SECOND = (
    "executor = 'two_levels:Lower', above = 'upper', reads = { plan = 'lower.plan' }, budget = {"
    " process_ms = 1 }"
)


def test_every_chain_of_levels_is_judged_and_has_one_longest_cycle(judge: Judge) -> None:
    # A board a joint: the second joint is slower than the level above.
    judged = judge(f"board.joint={{ slot = 9, core = 2, every = 16, {SECOND} }}")
    assert sides(judged, "3.3", "system, upper > lower") == [(30, "<=", 40, True)]
    assert sides(judged, "3.3", "system, upper > joint") == [(60, "<=", 80, True)]
    assert {sides(judged, "3.4", board)[0][2] for board in ("upper", "lower", "joint")} == {40}


def test_the_budgeted_rack_fits(judge: Judge) -> None:
    assert judge().failing == ()


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        # 8.5 / 1 < 5.55; its response 8.7 + 1 * 4.45 > 10.
        (
            ["within_cycles=1"],
            {("3.8", "lower"), ("response time", "lower.planner"), ("load", "core 1")},
        ),
        # C + U = 1.25 of 10.
        (["budget.update_ms=1.0"], {("3.10", "lower")}),
        (["budget.plan_within_ms=39"], {("plan within", "lower")}),
        (["budget.plan_within_ms=40"], set()),
        # 9 + 1.25 is more than the cycle, and leaves nothing to plan in.
        (
            ["budget.process_ms=9"],
            {
                (equation, "lower")
                for equation in ("3.1", "3.5", "3.6", "3.8", "3.9", "response time")
            }
            | {("response time", "lower.planner"), ("load", "core 1")},
        ),
        # The cycle is full to the brim: it fits, but a residual of 0 is none, and switches do not
        # fit.
        (
            ["budget.process_ms=8.75", "planner_priority=0"],
            {(equation, "lower") for equation in ("3.6", "3.8", "3.9", "response time")}
            | {("response time", "lower.planner"), ("load", "core 1")},
        ),
    ],
    ids=[
        "too few cycles",
        "long update",
        "old plans",
        "plans just in time",
        "too long",
        "to the brim",
    ],
)
def test_what_does_not_fit_fails_by_its_equations_and_no_others(
    judge: Judge, settings: list[str], expected: set[tuple[str, str]]
) -> None:
    assert failing(judge(*(f"board.lower.{setting}" for setting in settings))) == expected


def test_an_executor_longer_than_every_cycle_fails_equation_3_4(judge: Judge) -> None:
    assert ("3.4", "lower") in failing(judge("board.lower.budget.process_ms=20"))


def test_a_loose_planner_has_its_slice_instead(judge: Judge) -> None:
    judged = judge(*LOOSE)
    assert sides(judged, "fig. 4", "lower") == [(8.5, "<=", 40, True)]
    assert not {v.equation for v in judged.verdicts if v.subject == "lower"} & {
        "3.8",
        "3.9",
        "3.10",
    }
    assert ("fig. 4", "lower") in failing(judge(*LOOSE, "board.lower.budget.plan_ms=40"))


def test_levels_on_one_core_respond_later_though_each_equation_holds(judge: Judge) -> None:
    judged = judge("board.lower.core=0", "board.lower.within_cycles=2")
    assert sides(judged, "3.8", "lower")[0][3]
    # 8.7 with 4.45 of its executor every 10 and 4.2 of the upper level every 20.
    assert sides(judged, "response time", "lower.planner") == [
        (pytest.approx(8.7 + 4 * 4.45 + 2 * 4.2), "<=", 20, False)
    ]
    assert failing(judged) == {("response time", "lower.planner"), ("load", "core 0")}


def test_the_clock_takes_time_of_its_core(judge: Judge) -> None:
    judged = judge("timing.clock_ms=0.4")
    # 0.4 + 0.2 every 2.5 ms: two ticks come while the upper level computes 4.2.
    assert sides(judged, "response time", "upper") == [
        (pytest.approx(4.2 + 3 * 0.6), "<=", 20, True)
    ]
    assert sides(judged, "load", "core 0") == [(pytest.approx(0.6 / 2.5 + 4.2 / 20), "<=", 1, True)]


def test_a_critical_update_blocks_the_executor(judge: Judge) -> None:
    assert sides(judge(), "response time", "lower")[0][0] == pytest.approx(4.45)
    locked = judge("protocol.mailbox={ 'lower.plan' = 'lock' }")
    assert sides(locked, "response time", "lower")[0][0] == pytest.approx(4.95)


def test_a_response_without_bound_is_none_as_plain_data(judge: Judge) -> None:
    judged = judge("board.lower.budget.process_ms=9")
    verdict = next(
        v for v in judged.verdicts if (v.equation, v.subject) == ("response time", "lower.planner")
    )
    assert (verdict.left, verdict.margin) == (inf, -inf)
    assert (verdict.document()["left"], verdict.document()["margin"]) == (None, None)


def test_budgets_are_of_the_wall_clock_cycles_of_simulated_time(judge: Judge) -> None:
    assert sides(judge("clock.speed=2"), "3.1", "lower") == [(4.25, "<=", 5, True)]
    assert ("3.1", "lower") in failing(judge("clock.speed=4"))


def test_a_board_without_a_budget_is_not_judged(budgeted: object) -> None:
    judged = JudgedConfig.of(load(str(budgeted)), {})
    assert {verdict.subject for verdict in judged.verdicts} == {"system"}


def test_a_planner_that_the_budget_does_not_tell_of_is_not_judged(judge: Judge) -> None:
    judged = judge("board.lower.budget.plan_ms=0", "board.lower.budget.update_ms=0")
    assert not {v.equation for v in judged.verdicts if v.subject == "lower"} & {
        "3.8",
        "3.9",
        "3.10",
    }
    assert judged.timing.level("lower").within_cycles is None


def test_verdicts_stand_in_the_order_of_the_equations(judge: Judge) -> None:
    order = [verdict.equation for verdict in judge(*LOOSE).verdicts]
    found = list(dict.fromkeys(order))
    assert found == [
        "3.1",
        "3.2",
        "3.3",
        "3.4",
        "3.5",
        "3.6",
        "3.7",
        "fig. 4",
        "response time",
        "load",
    ]


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
    assert {v.equation for v in JudgedConfig.of(load(rack)).failing} == expected


def test_a_margin_is_what_the_right_side_has_left() -> None:
    assert (
        EquationVerdict("3.1", "servo", 3.0, "<=", 2.5, False, "t_proc + t_c <= R_i").margin == -0.5
    )
