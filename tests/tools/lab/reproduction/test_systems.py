"""The systems of the paper, and the number of levels in their runs."""

from __future__ import annotations

import pytest

from rack.boards.config import list_names
from rack.boards.config.files import CONFIGS
from rack.tools.lab.reproduction.experiments.mechanisms import measure_levels
from rack.tools.lab.reproduction.system_claims import SYSTEMS
from rack.tools.recording.recording import Recording


def test_the_systems_are_nasrem_and_every_bundled_rack_with_a_folder() -> None:
    folders = {path.stem for path in CONFIGS.glob("*/*.toml") if path.stem == path.parent.name}
    # A cell of several racks is none of the paper's systems.
    expected = {"nasrem", *folders & {*list_names()}} - {"cell"}
    assert {name.partition("/")[0] for name in SYSTEMS} == expected
    assert len(set(SYSTEMS)) == len(SYSTEMS)


@pytest.mark.slow
def test_levels_are_closed_loops_of_a_run(nasrem: Recording) -> None:
    levels = measure_levels(nasrem)
    assert levels == (7, 26, 325, 2600)
