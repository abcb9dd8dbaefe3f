"""A level whose executor is a state table: the row that fires, swaps at a tick, restarts, an
operator's commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from tests.boards.commanded_racks import commands
from tests.boards.config.mistakes import find_lines
from tests.boards.conftest import MakeConfig
from tests.boards.messages import Written
from tests.boards.table_racks import HOLE, SAW, counting

SWAP = 'level = "counter", what = "table", name = "slow", tick = 39'
SWAP_BACK = 'level = "counter", what = "table", name = "saw", tick = 59'
EDIT = 'fault=[{ kind = "kill", board = "counter", at = 0.1 }]'


def counted(config: RackConfig, seconds: float = 0.25) -> tuple[np.ndarray, str]:
    """Run a rack; return the statuses of its counter, one a cycle, and the digest."""
    with Rack(config) as rack:
        outcome = rack.run(seconds)
        return Written.on(rack.segment).messages["counter.status"]["message"], outcome.digest


@pytest.fixture
def counter(config: MakeConfig, tmp_path: Path) -> MakeConfig:
    return lambda *settings: config(*settings, text=counting(tmp_path))


@pytest.mark.slow
def test_tables_are_swapped_at_a_tick_and_every_run_alike(counter: MakeConfig) -> None:
    given = commands(SWAP, SWAP_BACK)
    (one, digest), (_, other) = counted(counter(given)), counted(counter(given))
    names = [name.decode() for name in one["table"]]
    assert names == ["saw"] * 10 + ["slow"] * 5 + ["saw"] * (len(names) - 15)
    # It stays where it was, and goes on from there.
    assert set(one["count"][10:15].tolist()) == {10}
    assert digest == other != counted(counter())[1]


@pytest.mark.slow
def test_a_restarted_board_reads_its_file_again_and_continues_in_its_state(
    counter: MakeConfig, tmp_path: Path
) -> None:
    with Rack(counter(EDIT)) as rack:
        (tmp_path / "saw.toml").write_text(SAW.replace('name = "count up"', 'name = "up it goes"'))
        rack.run(0.9)
        statuses = Written.on(rack.segment).messages["counter.status"]["message"]
    names = [name.decode() for name in statuses["fired"]]
    assert "count up" in names[:10]
    assert "count up" not in names[10:]
    assert "up it goes" in names[10:]
    assert len(set(statuses["checksum"].tolist())) == 2
    assert np.abs(np.diff(statuses["count"])).max() == 1


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """The config of the rack as a file beside its tables."""
    path = tmp_path / "counting.toml"
    path.write_text(counting(tmp_path))
    return path


def test_a_table_with_a_hole_is_refused_with_its_state_and_case(file: Path) -> None:
    file.with_name("saw.toml").write_text(HOLE)
    hole = "hole: no row of 'down' takes count = low, late = yes, command ="
    assert find_lines(file) == [
        f'board.counter.params.tables.saw = "saw.toml": {hole} {command}, new = no'
        for command in ("none|unknown", "reset")
    ]


def test_unknown_tables_and_commands_are_refused_with_the_known_ones(file: Path) -> None:
    given = commands(
        'level = "counter", what = "table", name = "swift", tick = 4',
        'level = "counter", what = "do", name = "reset middle", tick = 4',
        'level = "counter", what = "do", tick = 4',
    )
    assert find_lines(file, given) == [
        "command[0].name = \"swift\": table of 'counter' knows: saw, slow",
        "command[1].name = \"reset middle\": do of 'counter' knows: reset low, reset high",
        "command[2].name: do of 'counter' knows: reset low, reset high",
    ]


def test_a_missing_file_is_a_mistake_of_the_config(file: Path) -> None:
    found = find_lines(file, "board.counter.params.tables.saw=none.toml")
    assert 'params.tables.saw = "none.toml": cannot be read: No such file' in found[0]
