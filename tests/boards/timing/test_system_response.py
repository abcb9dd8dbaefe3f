"""The path of an operator's command, and its longest response, against arithmetic by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from rack.backplane.layout import TickGrid
from rack.boards.config import build_rack_timing, load, resolve_layout
from rack.boards.timing.command_path import CommandPath, find_command_paths


def path_of(levels: Sequence[str], grids: Sequence[TickGrid]) -> CommandPath:
    """Return a path whose first command takes a tick; each level reads in every cycle."""
    return CommandPath(tuple(levels), tuple(grids), tuple(grids), 1, True)


NASREM = path_of(
    ("task", "elemental_move", "primitive", "servo"),
    [TickGrid(every) for every in (400, 100, 8, 1)],
)


@pytest.mark.parametrize(
    ("given", "sampled", "acts"),
    [
        # Visible a tick later; each level's next release on the grid: 400, 800, 904 (900 is not a
        # multiple of 8), 912.
        (0, 400, 912),
        (399, 400, 912),
        (400, 800, 1312),
        # 1200 + 400 + 100 = 1700 is not a multiple of 8: 1704, and its slice.
        (800, 1200, 1712),
    ],
)
def test_a_command_is_followed_from_release_to_release(given: int, sampled: int, acts: int) -> None:
    assert NASREM.find_reading_release(given + 1) == sampled
    assert NASREM.find_acting_release(given + 1) == acts


def test_bounds_follow_the_paper_and_the_releases() -> None:
    assert NASREM.bound_eq_3_2 == 4 * 400
    assert NASREM.sum_eq_3_3 == 400 + 100 + 8 + 1
    # A cycle of the first level until it is read, the sum, and up to 4 ticks: 100 is not a multiple
    # of 8.
    assert NASREM.longest == 400 + 509 + 4


@pytest.mark.parametrize("cycles", [(400, 100, 8, 1), (12, 8, 3), (7, 5), (30, 12, 9, 2), (4,)])
def test_the_longest_response_is_reached_and_never_exceeded(cycles: tuple[int, ...]) -> None:
    path = path_of([str(cycle) for cycle in cycles], [TickGrid(cycle) for cycle in cycles])
    grid = int(np.lcm.reduce(cycles))
    slice_ticks = path.cycles[-1]
    found = [path.find_acting_release(at + 1) + slice_ticks - at for at in range(2 * grid)]
    assert max(found) <= path.longest
    if len(cycles) <= 2:
        assert max(found) == path.longest


def test_paths_begin_at_every_level_that_can_be_commanded() -> None:
    config = load("nasrem")
    layout = resolve_layout(config)
    found = find_command_paths(build_rack_timing(config, layout), layout)
    assert found["task"] == NASREM
    assert found["primitive"] == path_of(("primitive", "servo"), [TickGrid(8), TickGrid(1)])
    assert list(found) == ["task", "elemental_move", "primitive", "servo"]
