"""The rack of state tables, from its config: it picks a block up, and goes on where its boards have
died."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.message import State
from rack.boards import Rack
from rack.boards.config import CONFIGS, load, loads
from rack.boards.config.resolved import resolve
from rack.boards.errors import ConfigError

FOLDER = CONFIGS / "nist-state-table"
TASKLESS = 'command=[{ level = "elemental_move", what = "do", name = "pick block1", tick = 100 }]'
KILLED = 'fault=[{ kind = "kill", board = "primitive", at = 0.3 }]'


def fired(rack: Rack, level: str) -> list[str]:
    """Return the names of the rows that fired in a level, in order, each once until another
    fires."""
    names = MailboxRing(rack.segment, f"{level}.status").drain().rows["message"]["fired"]
    return [name.decode() for at, name in enumerate(names) if not at or name != names[at - 1]]


@pytest.mark.slow
def test_it_picks_up_a_block_though_a_board_dies_on_the_way(rack_name: str) -> None:
    config = load("nist-state-table", [f"name={rack_name}", "clock.mode=lockstep", KILLED])
    with Rack(config) as rack:
        outcome = rack.run(4.3)
        model = MailboxRing(rack.segment, "world.model").drain().rows["message"]["position"]
        moves, motions = fired(rack, "elemental_move"), fired(rack, "primitive")
    assert not outcome.faults
    assert "at rest on the way: go on" in motions
    assert "got it: raise it" in moves
    heights = model[:, config.scene.objects.index("block1"), 2]
    assert heights[-1] > heights[0] + 0.01


@pytest.mark.slow
def test_without_a_task_level_the_operator_commands_the_elemental_moves(rack_name: str) -> None:
    config = load(FOLDER / "direct.toml", [f"name={rack_name}", "clock.mode=lockstep", TASKLESS])
    with Rack(config) as rack:
        rack.run(0.8)
        statuses = MailboxRing(rack.segment, "elemental_move.status").drain().rows["message"]
    assert statuses["words"][-1] == b"pick block1"
    assert set(statuses["state"][12:].tolist()) == {State.EXECUTING}
    assert np.unique(statuses["in_state"]).tolist() == [b"idle", b"reaching"]


def test_a_place_that_the_level_below_does_not_know_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "task.toml"
    path.write_text(
        (FOLDER / "tables" / "task.toml").read_text().replace('place = "left"', 'place = "roof"')
    )
    with pytest.raises(ConfigError) as caught:
        resolve(load("nist-state-table", [f"board.task.params.tables.normal={path}"]))
    expected = (
        "plan.step[1].place: unknown 'roof'; 'elemental_move' knows: pick block1, pick block2, pick"
        " peg, place right"
    )
    assert expected in str(caught.value)


def test_a_command_that_one_table_of_a_level_does_not_know_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "careful.toml"
    lines = (FOLDER / "tables" / "elemental_move_careful.toml").read_text().splitlines()
    path.write_text("\n".join(line for line in lines if not line.startswith("left =")))
    with pytest.raises(ConfigError) as caught:
        resolve(load("nist-state-table", [f"board.elemental_move.params.tables.careful={path}"]))
    assert (
        str(caught.value)
        == 'board.elemental_move.params.tables.careful = "careful.toml": does not know \'place'
        " left', as 'normal' does; all tables of a level know the same commands"
    )


@pytest.mark.parametrize("variant", [FOLDER / "nist-state-table.toml", FOLDER / "direct.toml"])
def test_its_configs_are_sound(variant: Path) -> None:
    config = load(variant)
    assert resolve(config).layout.tasks
    assert loads(config.text()) == config
