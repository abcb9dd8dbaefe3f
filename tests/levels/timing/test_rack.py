"""A rack as plain data: its chains, its longest cycles, and the verdicts on the paper's figure 3."""

from __future__ import annotations

from dataclasses import replace

from rack.levels.timing.forecast import Forecast
from rack.levels.timing.rack import BoardTiming, RackTiming
from rack.levels.timing.tasks import Budget, TimedTask
from rack.levels.timing.verdicts import verdicts

MS = 1_000_000
CLOCK = TimedTask("clock", "clock", "clock", 0, 90, 2 * MS, ())
FIGURE_3 = BoardTiming(
    name="level",
    above=(),
    below=(),
    coupling="tight",
    every=3,
    within_cycles=3,
    core=1,
    priority=80,
    planner_core=1,
    planner_priority=0,
    has_planner=True,
    is_critical=True,
    budget=Budget(read_ns=MS, process_ns=2 * MS, write_ns=MS, plan_ns=6 * MS, update_ns=MS),
)


def rack(*boards: BoardTiming, goal_ns: float | None = None) -> RackTiming:
    return RackTiming(False, 1.0, 2 * MS, CLOCK, {board.name: board for board in boards}, 0, 0.2, goal_ns)


def board(name: str, every: int, above: str = "", below: str = "") -> BoardTiming:
    above_, below_ = tuple(above.split()), tuple(below.split())
    return replace(FIGURE_3, name=name, every=every, above=above_, below=below_, budget=None)


def test_figure_3_fails_as_in_the_paper_from_plain_data() -> None:
    failing = {(verdict.equation, verdict.subject) for verdict in verdicts(rack(FIGURE_3)) if not verdict.holds}
    assert failing == {("3.8", "level"), ("response time", "level.planner"), ("load", "core 1")}
    # The paper's own way out: cycles of 8 ms, figure 2.
    longer = rack(FIGURE_3).changed("level", every=4, within_cycles=2)
    assert all(verdict.holds for verdict in verdicts(longer))


def test_a_planner_has_the_ceiling_of_its_executor_only_in_a_critical_section() -> None:
    planners = [rack(replace(FIGURE_3, is_critical=critical)).tasks[1] for critical in (True, False)]
    assert [(planner.ceiling, planner.locked_ns) for planner in planners] == [(80, MS), (0, 0)]


def test_every_chain_runs_from_a_highest_board_to_a_lowest() -> None:
    timing = rack(board("top", 40, below="a"), board("a", 4, "top"), board("b", 60, "top"), board("alone", 7))
    assert timing.chains == (("top", "a"), ("top", "b"))
    assert timing.hierarchy == ("top", "b")
    assert timing.longest_cycles == {"top": 60, "a": 60, "b": 60, "alone": 7}


def test_a_goal_for_the_response_is_divided_among_the_levels() -> None:
    timing = rack(board("top", 40, below="a"), board("a", 4, "top"), board("alone", 7), goal_ns=30 * 2.0 * MS)
    assert timing.longest_cycles == {"top": 15, "a": 15, "alone": 7}


def test_boards_without_a_budget_are_named_and_not_judged() -> None:
    forecast = Forecast.of(rack(board("top", 40, below="a"), board("a", 4, "top")))
    assert {verdict.subject for verdict in forecast.verdicts} == {"system"}
    assert any(note.endswith(": top, a") for note in forecast.notes)
