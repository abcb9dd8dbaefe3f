"""The draws of a campaign: values that a kind permits, and sizes that must be found."""

from __future__ import annotations

from itertools import pairwise
from random import Random

import pytest

from rack.boards.faults.drawing import BEYOND, Drawing, swept
from rack.boards.faults.kind import KINDS, Kind


def drawing(seed: int = 1) -> Drawing:
    """Return a generator's draws for a task of two ticks, read every eight, at 400 Hz."""
    return Drawing(Random(seed), cycle=2, reader=8, second=400.0, joints=6)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_drawn_values_are_permitted_ones(kind: Kind) -> None:
    for seed in range(40):
        d = drawing(seed)
        for parameter in kind.parameters:
            if parameter.drawn is not None:
                value = parameter.drawn(d)
                assert parameter.least <= value <= parameter.most
                assert value == int(value) or not parameter.is_whole
                assert parameter is not kind.size or value >= 0.999 * (kind.visible_from or 0)
        assert kind.lasts is None or kind.lasts(d) >= 1


def test_a_sweep_is_a_geometric_series_up_to_far_beyond_what_must_be_found() -> None:
    sizes = swept(0.001, 0.02, 4)
    assert (sizes[0], sizes[-1]) == (0.001, BEYOND * 0.02)
    assert [b / a for a, b in pairwise(sizes)] == pytest.approx([400 ** (1 / 3)] * 3, rel=1e-3)
    assert swept(0.001, 0.02, 1) == [0.001]
