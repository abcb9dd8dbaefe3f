"""Changes that make a rack fit: the smallest of each kind, verified on the whole rack."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from rack.boards.config import load, load_text
from rack.tools.timing.judged_config import JudgedConfig
from rack.tools.timing.repair import find_changes, find_repair
from rack.tools.timing.summary import format_fixes
from tests.tools.timing.conftest import Judge


def list_settings(judged: JudgedConfig) -> list[dict[str, object]]:
    return [change.settings for change in find_changes(judged, "lower")]


ELSEWHERE = {"coupling": "loose", "planner_slot": 4, "planner_core": 2}
LATE = "within_cycles=1"
"""8.5 of planning, 5.55 left in a cycle."""
OLDER, LONGER = {"within_cycles": 2}, {"every": 8, "rate_hz": None}
FULL = [
    f"board.other{slot}={{ slot = {slot}, executor = 'two_levels:Upper', below = 'lower', every ="
    " 8, core = 3 }"
    for slot in range(4, 22)
]
"""Boards in all other slots."""


@pytest.mark.parametrize(
    ("lower", "others", "cores", "expected"),
    [
        # 5, 6 and 7 ticks are no grid with 8: waiting for it would take more than n R_max. Core 0
        # has 4.2 of every 20 ms to do, more than 10 - 8.7. A core that is not there comes last.
        ((LATE,), (), 2, [OLDER, LONGER, ELSEWHERE]),
        # One that it has comes before older plans.
        ((LATE,), (), 3, [ELSEWHERE, OLDER, LONGER]),
        # Plans must not grow old.
        ((LATE, "budget.plan_within_ms=15"), (), 2, [ELSEWHERE]),
        # Too long a cycle.
        (("budget.process_ms=9",), (), 2, [LONGER]),
        # No free slot for a planner.
        ((LATE,), FULL, 2, [OLDER, LONGER]),
    ],
)
def test_changes_are_the_smallest_of_each_kind_the_cheapest_first(
    judge: Judge,
    monkeypatch: pytest.MonkeyPatch,
    lower: Sequence[str],
    others: Sequence[str],
    cores: int,
    expected: list[dict[str, object]],
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: set(range(cores)))
    judged = judge(*(f"board.lower.{setting}" for setting in lower), *others)
    assert list_settings(judged)[: len(expected)] == expected
    assert len(list_settings(judged)) == len(expected) or cores == 3


def test_another_priority_costs_nothing_and_comes_first(judge: Judge) -> None:
    # Both on core 1, the slow level above the fast one: its 7.2 and 4.45 are more than the fast
    # one's 10.
    settings = ("core=1", "priority=85", "budget.process_ms=5")
    upper = (f"board.upper.{setting}" for setting in settings)
    judged = judge(*upper, "board.lower.budget.plan_ms=0.1")
    assert ("response time", "lower") in {(v.equation, v.subject) for v in judged.failures}
    first = find_changes(judged, "lower")[0]
    assert (first.settings, first.text) == ({"priority": 86}, "board 'lower': priority 80 -> 86")
    assert first.after.failures == ()


def test_every_change_is_a_config_that_holds_by_itself(judge: Judge) -> None:
    judged = judge("board.lower.within_cycles=1")
    for change in find_changes(judged, "lower"):
        config = load_text(change.after.config.to_toml_text())
        assert not JudgedConfig.judge(config, judged.budgets).failures


def test_the_next_smaller_change_does_not_help(judge: Judge) -> None:
    judged = judge("board.lower.budget.plan_ms=60")
    assert {"within_cycles": 11} in list_settings(judged)
    assert judge("board.lower.budget.plan_ms=60", "board.lower.within_cycles=10").failures
    assert not judge("board.lower.budget.plan_ms=60", "board.lower.within_cycles=11").failures


def test_a_critical_section_turns_into_a_time_slice_between_two_processors(judge: Judge) -> None:
    judged = judge("board.lower.within_cycles=1", "protocol.mailbox={ 'lower.plan' = 'lock' }")
    found = find_changes(judged, "lower")
    loosened = next(change for change in found if "coupling" in change.settings)
    assert loosened.after.layout.find_mailbox("lower.plan").protocol == "time-slice"
    assert loosened.to_document()["protocols"] == {"lower.plan": "time-slice"}
    assert "lower.plan by time-slice" in loosened.text


def test_a_longer_cycle_gives_a_plan_fewer_cycles_if_its_age_is_bounded() -> None:
    config = load("fig3")
    changes = find_changes(JudgedConfig.judge(config), "level")
    # The paper's remedies: its figure 4 first, then its figure 2.
    assert [change.settings for change in changes] == [
        {"coupling": "loose", "planner_slot": 3, "planner_core": 0},
        {"within_cycles": 2, "every": 4},
    ]


def test_boards_are_repaired_one_after_another(judge: Judge) -> None:
    judged = judge("board.lower.within_cycles=1", "board.upper.budget.process_ms=19")
    repaired = find_repair(judged)
    assert [changes[0].board for changes in repaired.steps] == ["lower", "upper"]
    assert repaired.end.failures == ()
    assert repaired.end.failures == ()
    # The second step builds on the first.
    assert repaired.end.config.board["lower"].within_cycles == 2
    for fix in repaired.list_fixes():
        assert not JudgedConfig.judge(fix.changes[-1].after.config).failures
        assert {change.board for change in fix.changes} == {"lower", "upper"}


def test_a_failure_that_no_change_removes_is_named(judge: Judge) -> None:
    hopeless = find_repair(judge("board.lower.budget.process_ms=200"))
    # Another core for the planner is not enough.
    assert [[*changes[0].settings] for changes in hopeless.steps] == [[*ELSEWHERE]]
    assert {verdict.equation for verdict in hopeless.end.failures} >= {"3.1", "3.4"}
    (line,) = format_fixes([*hopeless.list_fixes()], hopeless.end.failures)
    assert line.startswith("no change helps with 3.1 of lower, ")
    assert not hopeless.to_document()["fits"]


def test_a_rack_that_fits_needs_no_changes(judge: Judge) -> None:
    judged = judge()
    assert find_repair(judged).end is judged
    assert [*find_repair(judged).list_fixes()] == []


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate two cores, because texts name cores that the machine lacks."""
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {0, 1})


def test_a_loose_planner_moves_to_another_core(judge: Judge) -> None:
    loose = ["coupling=loose", "planner_slot=4", "planner_core=0", "budget.plan_ms=31"]
    # The upper level takes 8.4 of every 40.
    judged = judge(*(f"board.lower.{setting}" for setting in loose))
    assert {"planner_core": 2} in list_settings(judged)


def test_two_steps_loosen_the_planner_and_lengthen_the_cycle(judge: Judge) -> None:
    # A plan must not grow older than 40 ms, and takes 35 of them.
    budget = ("process_ms=13", "plan_ms=35", "plan_within_ms=40")
    repaired = find_repair(judge(*(f"board.lower.budget.{time}" for time in budget)))
    keys = [[*changes[0].settings] for changes in repaired.steps]
    assert keys == [[*ELSEWHERE], ["within_cycles", "every", "rate_hz"]]
    assert not repaired.end.failures
