"""The cell of two arms in two racks: one world frame, and a transfer by either arm."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rack.backplane.message import State
from rack.boards.config import CONFIGS, load, resolve
from rack.boards.config.schema import RackConfig
from rack.boards.errors import ConfigError
from rack.levels.messages import Error
from rack.levels.planning.collision import CollisionChecker
from rack.levels.planning.ik import InverseKinematics
from rack.levels.planning.pose import pointing, pose
from rack.levels.systems.cell.messages import Response
from tests.boards.lan.racks import run_together
from tests.levels.arms import cell, config
from tests.levels.whole_rack import WholeRack

ARMS = ("cell_puma", "cell_k1607")
BEGIN, HAND_OVER, END = (0.45, -0.30, 0.475), (0.62, 0.0, 0.475), (0.95, 0.25, 0.475)
"""Places of the part: at the start, between the arms, and on the far side, m."""
DOWN = (0.0, 0.0, -1.0)


def test_both_racks_see_the_same_table_and_part() -> None:
    puma, k1607 = (cell(name) for name in ARMS)
    for geom in ("floor", "table", "part"):
        one, other = (c.model.geom(geom) for c in (puma, k1607))
        np.testing.assert_array_equal(one.size, other.size)
        np.testing.assert_array_equal(one.friction, other.friction)
    for data, others in ((puma.start(), k1607.start()), (k1607.start(), puma.start())):
        for name in ("table", "part"):
            np.testing.assert_array_equal(data.geom(name).xpos, others.geom(name).xpos)
    np.testing.assert_array_equal(
        puma.model.body_mass[puma.bodies], k1607.model.body_mass[k1607.bodies]
    )
    np.testing.assert_array_equal(puma.model.opt.gravity, k1607.model.opt.gravity)


@pytest.mark.parametrize(
    ("arm", "column"), [("cell_puma", "k1607_column"), ("cell_k1607", "puma_column")]
)
def test_each_arm_has_the_column_of_the_other_in_its_way(arm: str, column: str) -> None:
    assert cell(arm).touch[cell(arm).arm_geoms, cell(arm).model.geom(column).id].all()


@pytest.mark.parametrize("arm", ARMS)
def test_both_arms_reach_the_place_between_them(arm: str) -> None:
    found, (_, scene) = cell(arm), config(arm)
    ik, free = InverseKinematics(found, 1990), CollisionChecker(found, scene).free
    assert ik.solutions(pose(HAND_OVER, pointing(DOWN, 0.0)).raised(0.1), found.home, free)


@pytest.mark.thorough
@pytest.mark.slow
def test_the_k1607_with_its_hand_transfers_the_part() -> None:
    actions: list[dict[str, Any]] = [{"do": "transfer", "object": "part", "to": list(HAND_OVER)}]
    rack = WholeRack("nasrem", "cell_k1607", actions)
    status = rack.run_to_end(25.0)
    assert (status.state, status.error) == (State.DONE, Error.NONE), status.reason
    np.testing.assert_allclose(rack.read("world.model").position[0], HAND_OVER, atol=2e-3)
    servo = rack.read("servo.status")
    assert servo.touches == servo.violations == servo.clipped == 0


TWO_SHARED = """
extends = ["{puma}"]

[board.servo.reads]
others = ["lan.shared", "lan.third"]

[adapter.lan.import.third]
from = "cell-other/servo.shared"
type = "rack.levels.systems.cell.shared_bodies:SHARED_BODIES"
rate_hz = 50
max_age_ms = 200
"""


def test_a_rack_may_share_with_several_others(tmp_path: Path) -> None:
    (tmp_path / "three.toml").write_text(TWO_SHARED.format(puma=CONFIGS / "cell" / "puma.toml"))
    servo = next(
        task for task in resolve(load(tmp_path / "three.toml")).tasks if task.task == "servo"
    )
    assert servo.inputs["others"] == {"lan.shared": "lan.shared", "lan.third": "lan.third"}


MISTAKES = {
    "unknown": (
        'board.servo.params.shared=["prt"]',
        'board.servo.params.shared = "prt": not in the scene; objects: part',
    ),
    "twice": (
        'board.servo.params.shared=["part", "part"]',
        'board.servo.params.shared = "part": named twice',
    ),
    "none": ("board.servo.params.shared=[]", "should have at least 1 item"),
    "too many": (
        'board.servo.params.shared=["a", "b", "c", "d", "e"]',
        "should have at most 4 items",
    ),
    "no copies": (
        "board.servo.params.arm=rack.levels.arm:SimulatedArm",
        "the arm shares no objects; permitted: rack.levels.systems.cell.sharing_arm:SharingArm",
    ),
    "from nowhere": ("board.servo.reads.others=lan.shred", '"lan.shred": no task writes it'),
    "of another type": (
        "board.servo.reads.others=servo.scene",
        "carries scene 1; the port needs shared_bodies 1",
    ),
    "without sharing": (
        "board.servo.executor=rack.levels.servo:ServoExecutor",
        "board.servo.params.shared",
    ),
}


@pytest.mark.parametrize(("setting", "line"), MISTAKES.values(), ids=MISTAKES)
def test_mistakes_about_shared_bodies_are_named(setting: str, line: str) -> None:
    with pytest.raises(ConfigError) as error:
        resolve(load(CONFIGS / "cell" / "puma.toml", [setting]))
    assert line in str(error.value)


def test_an_obstacle_cannot_be_shared(tmp_path: Path) -> None:
    robot = CONFIGS / "robots" / "puma560_crossing.toml"
    text = f'extends = ["{CONFIGS / "cell" / "puma.toml"}", "{robot}"]\ntask = {{}}\n'
    (tmp_path / "post.toml").write_text(text)
    with pytest.raises(ConfigError) as error:
        resolve(
            load(
                tmp_path / "post.toml",
                ['board.servo.params.shared=["post"]', "task.action=[]", "scene.goal=[]"],
            )
        )
    assert "an obstacle, which moves by itself; objects: block1, block2, peg" in str(error.value)


def racks(name: str, folder: Path) -> list[RackConfig]:
    """Return coordinator and arms, in lockstep, under names and on sockets of their own."""
    for file in (CONFIGS / "cell").glob("*.toml"):
        text = file.read_text().replace('"../', '"')
        (folder / file.name).write_text(re.sub(r'(?<=["/])cell(?=["/-])', name, text))
    return [
        load(folder / f"{rack}.toml", ["clock.mode=lockstep"]) for rack in ("cell", "puma", "k1607")
    ]


@pytest.mark.slow
def test_the_three_racks_begin_the_program_together(rack_name: str, tmp_path: Path) -> None:
    found = run_together(racks(rack_name, tmp_path), [4.0] * 3)
    assert [one.outcome.cause for one in found] == ["time over"] * 3, [one.texts for one in found]
    cell, puma, k1607 = (one.last for one in found)
    assert (cell["task.status"]["state"], cell["task.status"]["moves"]) == (State.EXECUTING, 2)
    for arm, other in ((puma, k1607), (k1607, puma)):
        assert arm["task.report"]["response"] == Response.DOING
        assert arm["elemental_move.status"]["progress"] > 0.0, (
            "it is on its way, slowly: it has time"
        )
        np.testing.assert_array_equal(
            arm["lan.shared"]["bodies"]["name"], other["servo.shared"]["bodies"]["name"]
        )
        assert arm["lan.status"]["import_shared"]["taken"] == 199
