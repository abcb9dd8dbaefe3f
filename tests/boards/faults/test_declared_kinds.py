"""What every kind of fault declares, with the values that a campaign draws for it."""

from __future__ import annotations

from dataclasses import fields
from itertools import pairwise
from random import Random
from typing import Any

import pytest

from rack.boards.faults.drawing import MAX_SIZE_RATIO, Drawing, list_sweep_sizes
from rack.boards.faults.kind import KINDS, Kind, Parameter
from rack.boards.faults.kinds import BUILT_IN
from tests.snapshots import Snapshots

SNAPSHOTS = Snapshots(__file__)
DRAWS = 20


def declared(record: Kind | Parameter) -> dict[str, Any]:
    """Return what a record holds, but for functions."""
    values = {field.name: getattr(record, field.name) for field in fields(record)}
    return {
        name: value
        for name, value in values.items()
        if not callable(value) and name not in ("bound", "parameters", "step")
    }


@pytest.mark.parametrize("kind", [*KINDS], ids=lambda kind: kind.name)
def test_the_declaration_of_each_kind_is_unchanged(kind: Kind) -> None:
    parameters = [declared(parameter) for parameter in kind.parameters]
    told = [declared(kind), parameters, str(kind.bound), kind.number]
    # What a campaign draws for each parameter, and how long the fault lasts.
    draws = [parameter.drawn for parameter in kind.parameters] + [kind.lasts]
    basis = Drawing(Random(7), cycle=8, reader=100, second=400.0, joints=6)
    drawn = [[draw(basis) for _ in range(DRAWS)] for draw in draws if draw]
    SNAPSHOTS.check(kind.name, {"declared": told, "drawn": drawn})


def test_every_kind_of_the_project_is_known() -> None:
    assert SNAPSHOTS.known.keys() == BUILT_IN


@pytest.mark.parametrize("kind", [*KINDS], ids=lambda kind: kind.name)
def test_drawn_values_are_permitted_ones(kind: Kind) -> None:
    for seed in range(40):
        d = Drawing(Random(seed), cycle=2, reader=8, second=400.0, joints=6)
        for parameter in kind.parameters:
            if parameter.drawn is not None:
                value = parameter.drawn(d)
                assert parameter.least <= value <= parameter.most
                assert value == int(value) or not parameter.is_whole
                assert parameter is not kind.size or value >= 0.999 * (kind.visible_from or 0)
        assert kind.lasts is None or kind.lasts(d) >= 1


def test_a_sweep_extends_from_the_least_size_beyond_the_visible_size() -> None:
    sizes = list_sweep_sizes(0.001, 0.02, 5)
    assert (sizes[0], sizes[-1]) == (0.001, pytest.approx(MAX_SIZE_RATIO * 0.02))
    ratios = [after / before for before, after in pairwise(sizes)]
    assert ratios == pytest.approx([ratios[0]] * 4, rel=1e-2)
    assert list_sweep_sizes(0.001, 0.02, 1) == [0.001]
