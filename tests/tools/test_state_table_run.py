"""A recorded run of a level with state tables: the rows that fired are in the report and in the
viewer's recording."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rack.tools.recording.recording import Recording
from rack.tools.viewer.reading import read_component
from tests.boards.commanded_racks import commands
from tests.boards.table_racks import counting
from tests.tools.command_line import rack

SWAP = commands('level = "counter", what = "table", name = "slow", tick = 59')


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that swaps its table after 15 cycles."""
    here = tmp_path_factory.mktemp("counting")
    path = here / "counting.toml"
    path.write_text(counting(here))
    words = ("--seconds", "0.25", "--out", here / "run", "--set", "name=counting", "--set", SWAP)
    done = rack("run", path, *words)
    assert done.returncode == 0, done.stderr
    return here / "run"


@pytest.mark.slow
def test_the_report_counts_the_rows_that_fired(folder: Path) -> None:
    rows = json.loads((folder / "report.json").read_text())["state_tables"]["counter"]
    assert [(row["table"], row["row"], row["name"], row["cycles"]) for row in rows] == [
        ("saw", 3, "count up", 10),
        ("saw", 4, "turn", 1),
        ("saw", 5, "count down", 4),
        ("slow", 3, "settle", 1),
        ("slow", 4, "rest", 9),
    ]
    assert rows[1]["first_s"] == 0.1
    text = (folder / "report.md").read_text()
    assert "| counter | saw   | 3   | count up   | 10     |" in text
    assert str(folder.parent / "slow.toml") in Recording(folder).config


@pytest.mark.slow
def test_the_viewer_has_a_lane_of_rows_and_a_line_a_change(folder: Path) -> None:
    states = read_component(folder / "run.rrd", "/levels/1-counter/row", "StateChange:state")
    lines = read_component(folder / "run.rrd", "/log/rows", "TextLog:text")
    assert states.ticks.tolist() == [0, 40, 44, 60, 64]
    rows = ["3 count up", "4 turn", "5 count down", "3 settle", "4 rest"]
    assert [str(value) for value in states.values.ravel()] == rows
    assert "tick 40: counter: row 4 'turn', now in 'down', table saw" in {
        str(value) for value in lines.values.ravel()
    }
