"""Draws of parameters and durations: within their ranges, with both ends, the same for a seed."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

import pytest

from rack.boards.faults import drawing
from rack.boards.faults.drawing import BEYOND, Drawing

CYCLE, READER, SECOND, JOINTS = 8, 100, 400.0, 6


def draws(draw: Callable[[Drawing], float], reader: int = READER) -> list[float]:
    """Return many draws of one seed."""
    basis = Drawing(Random(7), CYCLE, reader, SECOND, JOINTS)
    return [draw(basis) for _ in range(2000)]


@pytest.mark.parametrize(
    ("draw", "least", "most"),
    [
        (drawing.number(2.0, 5.0), 2.0, 5.0),
        (drawing.whole(2, 5), 2, 5),
        (drawing.magnitude(0.01, 10.0), 0.01, 10.0),
        (drawing.size_from(0.02), 0.02, BEYOND * 0.02),
        (drawing.seconds(0.5, 2.0), 200, 800),
        (drawing.cycles(2, 4), 16, 32),
        (drawing.messages(10, 40), 200, 320),
        (drawing.longest(drawing.cycles(2, 4), drawing.seconds(0.05, 0.05)), 20, 32),
        (drawing.silence(1.0, 2.0), 116, 232),
    ],
)
def test_a_draw_fills_its_range(
    draw: Callable[[Drawing], float], least: float, most: float
) -> None:
    found = draws(draw)
    assert least <= min(found) <= least + 0.02 * (most - least)
    assert most - 0.02 * (most - least) <= max(found) <= most
    assert found == draws(draw)


def test_sizes_are_spread_over_magnitudes() -> None:
    found = draws(drawing.magnitude(0.01, 10.0))
    # A third of them in each decade.
    for low in (0.01, 0.1, 1.0):
        share = sum(low <= value < 10 * low for value in found) / len(found)
        assert share == pytest.approx(1 / 3, abs=0.05)
    # As a file shows them.
    assert all(value == float(f"{value:.4g}") for value in found)


def test_a_duration_has_a_tick_at_least_and_two_reads_of_the_reader() -> None:
    assert set(draws(drawing.seconds(0.0, 0.0))) == {1}
    assert set(draws(drawing.messages(1, 2))) == {2 * READER}
    assert set(draws(drawing.messages(1, 2), reader=1)) == {CYCLE, 2 * CYCLE}


@pytest.mark.parametrize(("draw", "share"), [(drawing.joint, 0.1), (drawing.joint_or_all, 0.5)])
def test_some_faults_are_of_all_joints(draw: Callable[[Drawing], float], share: float) -> None:
    found = draws(draw)
    assert set(found) == {-1, *range(JOINTS)}
    assert found.count(-1) / len(found) == pytest.approx(share, abs=0.04)
