"""The rack of state tables: it picks up a block, although boards die, and invalid tables fail."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.boards import Rack
from rack.boards.config import CONFIGS, load
from rack.levels.systems.state_table.task import TaskPlanConfig, TaskTable
from rack.levels.tables import SceneConfig
from tests.boards.config.mistakes import find_mistake

FOLDER = CONFIGS / "nist-state-table"
KILLED = 'fault=[{ kind = "kill", board = "primitive", at = 0.3 }]'


def list_fired_rows(rack: Rack, level: str) -> list[str]:
    """Return the names of the rows that fired in a level, in order, without repetitions."""
    names = MailboxRing(rack.segment, f"{level}.status").read_new_rows().rows["message"]["fired"]
    return [name.decode() for at, name in enumerate(names) if not at or name != names[at - 1]]


@pytest.mark.slow
def test_the_rack_picks_up_a_block_although_a_board_dies(rack_name: str) -> None:
    config = load("nist-state-table", [f"name={rack_name}", "clock.mode=lockstep", KILLED])
    with Rack(config) as rack:
        outcome = rack.run(4.3)
        model = MailboxRing(rack.segment, "world.model").read_new_rows().rows["message"]["position"]
        moves, motions = list_fired_rows(rack, "elemental_move"), list_fired_rows(rack, "primitive")
    assert not outcome.faults
    assert "at rest on the way: go on" in motions
    assert "got it: raise it" in moves
    heights = model[:, config.scene.objects.index("block1"), 2]
    assert heights[-1] > heights[0] + 0.01


def test_a_place_that_the_level_below_does_not_know_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "task.toml"
    text = (FOLDER / "tables" / "task.toml").read_text()
    path.write_text(text.replace('place = "left"', 'place = "roof"'))
    known = "pick block1, pick block2, pick peg, place right"
    mistake = find_mistake("nist-state-table", f"board.task.params.tables.normal={path}")
    assert f"plan.step[1].place: unknown 'roof'; 'elemental_move' knows: {known}" in mistake


def test_objects_that_the_scene_lacks_are_named() -> None:
    steps = [{"object": name, "place": "x"} for name in ("a", "b")]
    plan, scene = TaskPlanConfig(step=steps), SceneConfig(objects=("a", "c"))
    flaws = TaskTable.find_plan_flaws(scene, plan)
    assert flaws == ["plan.step[1].object: unknown 'b'; objects: a, c"]


def test_a_command_that_one_table_of_a_level_does_not_know_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "careful.toml"
    lines = (FOLDER / "tables" / "elemental_move_careful.toml").read_text().splitlines()
    path.write_text("\n".join(line for line in lines if not line.startswith("left =")))
    key = "board.elemental_move.params.tables.careful"
    lacking = "does not know 'place left', as 'normal' does"
    why = f'"careful.toml": {lacking}; all tables of a level know the same commands'
    assert find_mistake("nist-state-table", f"{key}={path}") == f"{key} = {why}"
