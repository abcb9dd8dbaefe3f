"""Figure 5: levels in the regions of implementation by their cycles."""

from __future__ import annotations

import pytest

from rack.boards.config import load
from rack.tools.timing.charts.figure5 import find_region, place_levels


@pytest.mark.parametrize(
    ("cycle_s", "region"),
    [
        (0.000999, "fine-grained"),
        *((0.001, "asynchronous"), (0.25, "asynchronous")),
        *((0.2501, "multitasking"), (60.0, "multitasking")),
        *((61.0, "distributed"), (86_400.0, "distributed")),
    ],
)
def test_a_cycle_falls_into_the_region_of_the_figure(cycle_s: float, region: str) -> None:
    assert find_region(cycle_s).name == region


def test_the_levels_of_nasrem_fall_where_the_paper_has_them() -> None:
    found = {level.level: level for level in place_levels(load("nasrem"))}
    assert list(found) == ["servo", "primitive", "world", "elemental_move", "task"]
    regions = [level.region for level in found.values()]
    assert regions == ["asynchronous multiprocessing"] * 4 + ["multitasking"]
    assert "coupled loosely, as in the figure" in found["elemental_move"].remark
    assert "coupled tightly, as in the figure" in found["task"].remark
    assert "a separate processor; here it is coupled tightly" in found["servo"].remark
    assert "no planner" in found["world"].remark
