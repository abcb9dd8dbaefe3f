"""The systems of the paper, and the number of levels in their configs."""

from __future__ import annotations

from pathlib import Path

from rack.boards.config import list_names
from rack.boards.config.files import CONFIGS
from rack.tools.lab.reproduction.claims import SYSTEMS
from rack.tools.lab.reproduction.rules import judge_layers
from rack.tools.lab.reproduction.verdict import Ruling, describe_unmet
from tests.boards.conftest import PLAIN


def test_the_systems_are_nasrem_and_every_bundled_rack_with_a_folder() -> None:
    folders = {path.stem for path in CONFIGS.glob("*/*.toml") if path.stem == path.parent.name}
    # A cell of several racks is none of the paper's systems.
    expected = {"nasrem", *folders & {*list_names()}} - {"cell"}
    assert {name.partition("/")[0] for name in SYSTEMS} == expected
    assert len(set(SYSTEMS)) == len(SYSTEMS)


def test_levels_are_read_from_a_config_alone() -> None:
    levels, faster = judge_layers(["nasrem"]).checks
    assert (levels.measured, faster.measured) == (4, 0)


def test_a_rack_without_a_hierarchy_fails_the_claim_on_two_levels(tmp_path: Path) -> None:
    path = tmp_path / "lone.toml"
    path.write_text(PLAIN.replace('below = "wave"', 'reads = { below = "wave.status" }'))
    verdict = judge_layers([str(path)])
    assert verdict.ruling is Ruling.FAILS
    assert "_levels 0, not >= 2" in describe_unmet(verdict.checks)
