"""Systems next to each other: what their configs promise, whatever their levels are."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.boards.config import load, names
from rack.boards.config.files import CONFIGS
from rack.tools.lab.reproduction.claims import SYSTEMS
from rack.tools.lab.reproduction.experiments.systems import prediction
from tests.boards.conftest import PLAIN


def test_the_systems_are_nasrem_and_every_bundled_rack_with_a_folder() -> None:
    folders = {path.stem for path in CONFIGS.glob("*/*.toml") if path.stem == path.parent.name}
    # A cell of several racks is none of the paper's systems.
    expected = {"nasrem", *folders & {*names()}} - {"cell"}
    assert {name.partition("/")[0] for name in SYSTEMS} == expected
    assert len(set(SYSTEMS)) == len(SYSTEMS)


def test_what_a_config_promises_is_read_from_it_alone() -> None:
    found = prediction(load("nasrem"))
    assert found.levels == ("task", "elemental_move", "primitive", "servo")
    assert found.rates_hz == pytest.approx((1, 4, 50, 400))


def test_a_rack_without_levels_above_each_other_promises_no_response(tmp_path: Path) -> None:
    path = tmp_path / "lone.toml"
    path.write_text(PLAIN.replace('below = "wave"', 'reads = { status = "wave.status" }'))
    found = prediction(load(path))
    assert (found.levels, found.rates_hz) == ((), ())
