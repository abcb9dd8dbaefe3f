"""The paper's timing model against the paper's own numbers (figs 2 to 4, section 3.4)."""

from __future__ import annotations

import pytest

from rack.levels.timing import equations as timing
from rack.levels.timing.equations import Relation

MS = 1_000_000
READ = WRITE = UPDATE = PLANNER_EXCHANGE = 1 * MS
EXECUTE = (1 * MS, 2 * MS, 3 * MS)
PLAN = 6 * MS
WORST_PLAN_CYCLES = 3


def residual(cycle_ns: int, executions_ns: tuple[int, ...]) -> float:
    return timing.residual_bound_ns(cycle_ns, executions_ns, [READ + WRITE])


@pytest.mark.parametrize(
    ("left", "sign", "right", "holds"),
    [
        (2, "<", 3, True),
        (3, "<", 3, False),
        (3, "<=", 3, True),
        (4, "<=", 3, False),
        (3, "=", 3, True),
        (2, "=", 3, False),
    ],
)
def test_a_relation_is_as_true_as_its_sides_make_it(
    left: int, sign: str, right: int, holds: bool
) -> None:
    assert bool(Relation(left, sign, right)) == holds


def test_figure_2_one_processor_with_8_ms_cycles_plans_in_time() -> None:
    left = residual(8 * MS, EXECUTE)
    assert left == 3 * MS
    assert timing.plan_fits_tight(PLAN + UPDATE, WORST_PLAN_CYCLES, left, 0)


def test_figure_2_with_2_ms_of_executor_plans_within_16_ms() -> None:
    left = residual(8 * MS, (2 * MS,))
    assert timing.plan_fits_tight(PLAN + UPDATE, 2, left, 0) == (3.5 * MS, "<", 4 * MS)


def test_figure_3_one_processor_with_6_ms_cycles_has_no_plan_within_three_cycles() -> None:
    left = residual(6 * MS, EXECUTE)
    assert left == 1 * MS
    relation = timing.plan_fits_tight(PLAN + UPDATE, WORST_PLAN_CYCLES, left, 0)
    assert not relation
    assert relation.right - relation.left == pytest.approx(-4 / 3 * MS)


def test_figure_4_two_processors_with_6_ms_cycles_plan_in_time() -> None:
    assert timing.fits_cycle(max(EXECUTE), PLANNER_EXCHANGE + READ + WRITE, 6 * MS) == (
        6 * MS,
        "<=",
        6 * MS,
    )
    assert timing.plan_fits_loose(PLAN + UPDATE, 2, 6 * MS) == (7 * MS, "<=", 12 * MS)
    assert not timing.plan_fits_loose(PLAN + UPDATE, 1, 6 * MS)


def test_figure_4_with_a_longer_executor_has_no_time_to_talk_to_its_planner() -> None:
    assert timing.fits_cycle(4 * MS, READ + WRITE, 6 * MS)
    longer = timing.fits_cycle(4 * MS, PLANNER_EXCHANGE + READ + WRITE, 6 * MS)
    assert longer == (7 * MS, "<=", 6 * MS)


def test_context_switches_come_off_the_residual_twice() -> None:
    assert timing.plan_fits_tight(5.9 * MS, 2, 3 * MS, 0)
    assert not timing.plan_fits_tight(5.9 * MS, 2, 3 * MS, 0.1 * MS)


def test_a_plan_that_needs_all_of_the_residual_does_not_fit() -> None:
    assert not timing.plan_fits_tight(6 * MS, 2, 3 * MS, 0)


def test_residual_is_what_the_worst_execution_and_the_worst_communication_leave() -> None:
    alpha = timing.residual_bound_ns(8 * MS, [1 * MS, 3 * MS], [2 * MS, 1 * MS])
    assert alpha == 3 * MS
    assert timing.residual_is_left(alpha)
    assert not timing.residual_is_left(0)


def test_residual_deviation_is_zero_only_for_equal_cycles() -> None:
    assert timing.residual_deviation_ns([3, 3, 3], [1, 1, 1]) == 0
    assert timing.residual_deviation_ns([2, 4], [1, 1]) == pytest.approx(1.0)


def test_system_responds_within_as_many_longest_cycles_as_there_are_levels() -> None:
    assert timing.system_response_bound_ns([2.5 * MS, 20 * MS, 250 * MS, 1000 * MS]) == 4000 * MS


def test_a_cycle_between_two_ticks_is_off_the_grid() -> None:
    assert timing.cycle_is_on_grid(20 * MS, 2_500_000)
    assert timing.cycle_is_on_grid(21 * MS, 2_500_000) == (21 * MS, "=", 20 * MS)
    assert not timing.cycle_is_on_grid(1 * MS, 2_500_000)


def test_parts_of_a_cycle_make_the_cycle_until_they_are_longer_than_it() -> None:
    assert timing.residual_ns(8 * MS, 3 * MS, 2 * MS) == 3 * MS
    assert timing.parts_make_cycle(3 * MS, 2 * MS, 8 * MS) == (8 * MS, "=", 8 * MS)
    assert timing.parts_make_cycle(4 * MS, 3 * MS, 6 * MS) == (7 * MS, "=", 6 * MS)
    assert not timing.parts_make_cycle(4 * MS, 3 * MS, 6 * MS)


def test_two_context_switches_come_on_top_of_a_tightly_coupled_cycle() -> None:
    # Figure 2, its cycle with the update, and the paper's 100 us a switch: 8 - 2 - 3 - 0.2.
    relation = timing.leaves_time_to_plan(2 * MS, READ + WRITE + UPDATE, 0.1 * MS, 8 * MS)
    assert relation.right - relation.left == pytest.approx(2.8 * MS)
    assert not timing.leaves_time_to_plan(2 * MS, 3 * MS, 0.1 * MS, 5.2 * MS)


def test_executor_must_leave_something_of_the_cycle() -> None:
    assert timing.executes_in_time(7 * MS, 8 * MS)
    assert not timing.executes_in_time(8 * MS, 8 * MS)


def test_plan_update_that_takes_much_of_a_cycle_asks_for_a_processor_of_its_own() -> None:
    assert not timing.coupling_may_be_tight(1 * MS, 8 * MS)
    assert timing.coupling_may_be_tight(1 * MS, 20 * MS)
    assert timing.coupling_may_be_tight(1 * MS, 8 * MS, small=0.2) == (0.125, "<=", 0.2)
