"""Non-linear tendons: pretension stiffens the joints, and a push takes nothing from a spring."""

from __future__ import annotations

import runpy

import numpy as np
import pytest

from rack.boards.config import CONFIGS, load
from rack.levels.robot.cell import build_cell
from rack.levels.systems.hand.simulated import SimulatedHand

SCRIPT = runpy.run_path(str(CONFIGS / "hic" / "stiffness.py"))
ARMS_M = np.array([0.012, 0.010, 0.008])
"""Moment arms of joints 1 to 3."""


@pytest.mark.slow
@pytest.mark.parametrize("rest_n", [5.0, 15.0, 40.0])
def test_stiffness_of_closed_valves_grows_with_pretension_as_the_spring_does(rest_n: float) -> None:
    expected = 2.0 * ARMS_M**2 * 140.0 * (rest_n + 20.7)
    assert SCRIPT["measure_stiffness"](rest_n, False) == pytest.approx(expected, rel=0.01)


@pytest.mark.slow
def test_open_valves_resist_a_short_push_less_but_the_more_the_higher_the_pretension() -> None:
    cases = (15.0, False), (15.0, True), (40.0, True)
    closed, soft, stiff = (SCRIPT["measure_stiffness"](*case) for case in cases)
    assert (0.4 * closed < soft).all()
    assert (soft < 0.8 * closed).all()
    # As in the ratio of the springs, 8500 to 5000 N/m.
    assert stiff / soft == pytest.approx(np.full(3, 1.7), rel=0.02)


@pytest.mark.parametrize("stiffening", [0.0, 0.0483])
def test_closed_valves_return_to_their_tension_when_a_push_ends(stiffening: float) -> None:
    config = load("hic", [f"robot.hand.stiffening={stiffening}"])
    cell = build_cell(config.robot, config.scene, config.clock_ns)
    hand = SimulatedHand(cell, config.scene, config.clock_ns)
    before = hand.commanded_tensions
    tip = hand.cell.model.site_bodyid[hand.hand.tips[0]]
    farthest = 0.0
    for force in (-0.5, 0.0):
        hand._data.xfrc_applied[tip, 1] = force
        hand.step(1500)
        farthest = max(farthest, float(np.abs(hand.commanded_tensions - before).max()))
    assert farthest > 1.0
    assert hand.commanded_tensions == pytest.approx(before, abs=1e-3)


@pytest.mark.slow
def test_the_page_has_the_table_that_the_command_prints(capsys: pytest.CaptureFixture[str]) -> None:
    SCRIPT["main"]([5.0, 15.0, 40.0])
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    page = (CONFIGS / "hic" / "README.md").read_text()
    for closed, opened in zip(rows[::2], rows[1::2], strict=True):
        pairs = [value for pair in zip(closed[2:], opened[2:], strict=True) for value in pair]
        assert f"| {' | '.join((closed[0], *pairs))} |" in page
