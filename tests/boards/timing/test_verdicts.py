"""The paper's equations against the paper's own numbers (figs 2 to 4, section 3.4)."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rack.backplane.layout import TickGrid
from rack.boards.timing.level import LevelTiming
from rack.boards.timing.rack import RackTiming, compute_grid_wait
from rack.boards.timing.tasks import TimedTask
from rack.boards.timing.verdicts import EquationVerdict, Sign, evaluate_level

MS = 1_000_000
TIGHT = LevelTiming(
    board="level",
    coupling="tight",
    cycle_ns=8 * MS,
    longest_cycle_ns=8 * MS,
    read_ns=MS,
    execution_ns=3 * MS,
    write_ns=MS,
    exchange_ns=0,
    plan_ns=6 * MS,
    update_ns=MS,
    within_cycles=3,
    plan_within_ns=None,
)
"""Figure 2, in its worst cycle."""
LOOSE = replace(TIGHT, coupling="loose", cycle_ns=6 * MS, exchange_ns=MS, within_cycles=2)
"""Figure 4."""


def judged(
    level: LevelTiming, equation: str, tick_ns: int = MS, switch_ns: int = 0
) -> tuple[float, str, float]:
    """Return both sides of an equation, ms or shares, and its sign; with ! if it fails."""
    clock = TimedTask("clock", "clock", "clock", 0, 90, tick_ns, ())
    rack = RackTiming(False, 1.0, tick_ns, clock, {}, switch_ns, 0.1, None, {}, None)
    (found,) = [found for found in evaluate_level(rack, level) if found.equation == equation]
    unit = 1 if found.unit == "1" else MS
    return found.left / unit, found.sign + "!" * (not found.holds), found.right / unit


@pytest.mark.parametrize(
    ("left", "sign", "right", "holds"),
    [
        *((2, "<", 3, True), (3, "<", 3, False)),
        *((3, "<=", 3, True), (4, "<=", 3, False)),
        *((3, "=", 3, True), (2, "=", 3, False)),
    ],
)
def test_an_equation_holds_if_its_sides_satisfy_it(
    left: int, sign: Sign, right: int, holds: bool
) -> None:
    verdict = EquationVerdict("3.1", "level", left, sign, right, "")
    assert (verdict.holds, verdict.margin) == (holds, right - left)
    assert verdict.to_document()["holds"] == holds


FIGURE_3 = {"cycle_ns": 6 * MS}
SHORTER = {"execution_ns": 2 * MS}


@pytest.mark.parametrize(
    ("equation", "level", "sides"),
    [
        ("3.1", TIGHT, (5, "<=", 8)),
        ("3.1", LOOSE, (6, "<=", 6)),
        ("3.1", replace(LOOSE, execution_ns=4 * MS), (7, "<=!", 6)),
        ("3.4", replace(TIGHT, longest_cycle_ns=4 * MS), (3, "<", 4)),
        ("3.4", replace(TIGHT, longest_cycle_ns=3 * MS), (3, "<!", 3)),
        ("3.5", TIGHT, (8, "=", 8)),
        ("3.5", replace(TIGHT, execution_ns=9 * MS), (11, "=!", 8)),
        ("3.6", TIGHT, (0, "<", 3)),
        ("3.6", replace(TIGHT, execution_ns=6 * MS), (0, "<!", 0)),
        ("3.7", TIGHT, (8, "=", 8)),
        # Of figure 2 with 2 ms of executor, the plan is there within 16 ms; of figure 3 never.
        ("3.8", replace(TIGHT, **SHORTER, within_cycles=2), (3.5, "<", 4)),
        ("3.8", replace(TIGHT, plan_ns=5 * MS, within_cycles=2), (3, "<!", 3)),
        ("3.8", replace(TIGHT, **FIGURE_3), (pytest.approx(7 / 3), "<!", 1)),
        ("fig. 4", LOOSE, (7, "<=", 12)),
        ("fig. 4", replace(LOOSE, within_cycles=1), (7, "<=!", 6)),
        ("3.9", replace(TIGHT, **SHORTER), (5, "<", 8)),
        ("3.10", TIGHT, (0.125, "<=!", 0.1)),
        ("3.10", replace(TIGHT, cycle_ns=20 * MS), (0.05, "<=", 0.1)),
        ("plan within", replace(TIGHT, plan_within_ns=24 * MS), (24, "<=", 24)),
        ("plan within", replace(TIGHT, plan_within_ns=23 * MS), (24, "<=!", 23)),
    ],
)
def test_a_level_is_judged_as_in_the_paper(
    equation: str, level: LevelTiming, sides: tuple[float, str, float]
) -> None:
    assert judged(level, equation) == sides


def test_a_cycle_between_two_ticks_is_off_the_grid() -> None:
    assert judged(TIGHT, "3.7", tick_ns=2_500_000) == (8, "=!", 7.5)
    assert judged(replace(TIGHT, cycle_ns=MS), "3.7", tick_ns=2_500_000) == (1, "=!", 2.5)


def test_two_context_switches_shorten_the_residual_and_lengthen_the_cycle() -> None:
    # The paper's 100 us a switch: figure 2 with 2 ms of executor has 8 - 2 - 3 - 0.2 ms left.
    level = replace(TIGHT, **SHORTER)
    assert judged(level, "3.9", switch_ns=MS // 10) == (5.2, "<", 8)
    short = replace(level, cycle_ns=5_200_000)
    assert judged(short, "3.9", switch_ns=MS // 10) == (5.2, "<!", 5.2)
    close = replace(TIGHT, plan_ns=4_900_000, within_cycles=2)
    assert judged(close, "3.8") == (2.95, "<", 3)
    assert judged(close, "3.8", switch_ns=MS // 10) == (2.95, "<!", 2.8)


def test_a_message_waits_for_the_next_read_on_the_grid() -> None:
    assert compute_grid_wait(TickGrid(8), TickGrid(4)) == 0
    assert compute_grid_wait(TickGrid(100), TickGrid(8)) == 4
    assert compute_grid_wait(TickGrid(4, 1), TickGrid(8, 2)) == 5
