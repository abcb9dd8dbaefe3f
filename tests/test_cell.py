"""The cell of two arms in two racks: one world frame, and a transfer by either arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.boards.config import CONFIGS, load, resolve
from tests.boards.config.mistakes import find_lines
from tests.levels.arms import cell

ARMS = ("cell_puma", "cell_k1607")
PUMA = CONFIGS / "cell" / "puma.toml"


def test_both_racks_see_the_same_table_and_part() -> None:
    puma, k1607 = (cell(name) for name in ARMS)
    for geom in ("floor", "table", "part"):
        one, other = (c.model.geom(geom) for c in (puma, k1607))
        np.testing.assert_array_equal(one.size, other.size)
        np.testing.assert_array_equal(one.friction, other.friction)
    data, others = puma.build_start_data(), k1607.build_start_data()
    for name in ("table", "part"):
        np.testing.assert_array_equal(data.geom(name).xpos, others.geom(name).xpos)
    np.testing.assert_array_equal(
        puma.model.body_mass[puma.bodies], k1607.model.body_mass[k1607.bodies]
    )
    np.testing.assert_array_equal(puma.model.opt.gravity, k1607.model.opt.gravity)


def test_a_rack_may_share_with_several_others() -> None:
    kind = "rack.levels.systems.coordination.shared_bodies:SharedBodies"
    third = f"{{from='cell-other/servo.shared', type='{kind}', rate_hz=50, max_age_ms=200}}"
    reads = "board.servo.reads.others=['lan.shared', 'lan.third']"
    rack = resolve(load(PUMA, [reads, f"adapter.lan.import.third={third}"]))
    servo = next(task for task in rack.tasks if task.task == "servo")
    assert servo.inputs["others"] == {"lan.shared": "lan.shared", "lan.third": "lan.third"}


MISTAKES = {
    "unknown": (
        'board.servo.params.shared=["prt"]',
        'board.servo.params.shared = "prt": is not in the scene; valid objects: part',
    ),
    "twice": (
        'board.servo.params.shared=["part", "part"]',
        'board.servo.params.shared = "part": is named more than once',
    ),
    "no copies": (
        "board.servo.params.arm=rack.levels.arm:SimulatedArm",
        "this arm cannot share objects; it must be"
        " rack.levels.systems.coordination.sharing_arm:SharingArm",
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
    assert any(line in found for found in find_lines(PUMA, setting))


def test_an_obstacle_cannot_be_shared(tmp_path: Path) -> None:
    robot = CONFIGS / "robots" / "puma560_crossing.toml"
    path = tmp_path / "post.toml"
    path.write_text(f'extends = ["{PUMA}", "{robot}"]\ntask = {{}}\n')
    settings = ('board.servo.params.shared=["post"]', "task.action=[]", "scene.goal=[]")
    why = "is an obstacle, which moves by itself; valid objects: block1, block2, peg"
    assert any(why in found for found in find_lines(path, *settings))
