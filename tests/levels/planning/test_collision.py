"""The collision checker on the PUMA's cell, against positions computed by hand."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import pytest

from rack.levels.compiled import preload
from rack.levels.planning import collision
from rack.levels.planning.collision import MAX_HELD_DEPTH_M, CollisionChecker, find_first_blocked
from rack.levels.planning.ik import InverseKinematics
from rack.levels.planning.pose import build_pointing_quaternion, make_pose
from rack.levels.robot.cell import Cell, build_cell
from tests.levels.arms import CLOCK_NS, ROBOTS, cell, config

BLOCK1, BLOCK2, PEG = 0, 1, 2


@pytest.fixture(scope="module")
def puma() -> Cell:
    return cell("puma560")


class Checker(CollisionChecker):
    """The checker of the PUMA's cell, which also finds configurations with the tool at a place."""

    def at(self, x: float, y: float, z: float) -> np.ndarray:
        """Return a configuration whose tool points straight down at a place."""
        pose = make_pose((x, y, z), build_pointing_quaternion((0.0, 0.0, -1.0)))
        return InverseKinematics(self.cell, 1).find_solutions(pose, self.cell.home)[0]


@pytest.fixture
def checker(puma: Cell) -> Checker:
    return Checker(puma, config("puma560")[1])


def test_arm_in_the_wall_is_not_free_and_the_wall_is_named(puma: Cell, checker: Checker) -> None:
    assert checker.is_free(puma.home)
    assert checker.describe_collision(puma.home) == ""
    assert checker.find_clearance(puma.home) == checker.clearance
    q = checker.at(0.5, 0.0, 0.7)
    assert not checker.is_free(q)
    assert "'wall'" in checker.describe_collision(q)
    assert checker.find_clearance(q) < 0


def test_clearance_decides_near_the_table_and_may_be_lowered(checker: Checker) -> None:
    # The fingers end 20 mm below the tool and the table is 0.45 m high: 10 mm are left.
    q = checker.at(0.45, -0.4, 0.48)
    assert not checker.is_free(q)
    assert checker.is_free(q, clearance=0.009)
    assert not checker.is_free(q, clearance=0.011)
    assert checker.find_clearance(q) == pytest.approx(0.010, abs=1e-4)


def test_pads_of_a_gripper_may_touch_even_if_the_model_pairs_them(tmp_path: Path) -> None:
    for file in ROBOTS.glob("puma560*.xml"):
        text = file.read_text()
        if file.name == "puma560.xml":
            pair = '<contact><pair geom1="pad_left" geom2="pad_right"/></contact>'
            text = text.replace("</mujoco>", f"{pair}</mujoco>")
        (tmp_path / file.name).write_text(text)
    robot, scene = config("puma560")
    robot = robot.model_copy(update={"model": tmp_path / Path(robot.model).name})
    puma = build_cell(robot, scene, CLOCK_NS)
    assert puma.model.npair == 1
    checker = CollisionChecker(puma, scene, margin=0.01)
    checker.open_gripper(0.0)
    assert checker.is_free(puma.home)


def test_the_gripper_may_only_touch_the_intended_block(checker: Checker) -> None:
    q = checker.at(0.5, 0.3, 0.475)
    assert not checker.is_free(q)
    checker.permit_contact(BLOCK1)
    assert checker.is_free(q)
    checker.permit_contact(BLOCK2)
    assert not checker.is_free(q)
    checker.permit_contact(None)
    assert not checker.is_free(q)
    # Open fingers must not go through it.
    checker.permit_contact(BLOCK1)
    assert "'block1'" in checker.describe_collision(checker.at(0.5, 0.3 + 0.02, 0.475))


def test_held_block_is_carried_and_keeps_clear_of_the_wall(checker: Checker) -> None:
    # The palm is clear of the wall; a block held 80 mm below the tool would stand in its top.
    q = checker.at(0.5, 0.0, 0.80)
    assert checker.is_free(q)
    checker.hold_object(BLOCK1, (0.0, 0.0, 0.05))
    assert not checker.is_free(q)
    assert "'block1'" in checker.describe_collision(q)
    checker.hold_object(None)
    assert checker.is_free(q)


def test_a_held_block_may_touch_the_table_only_if_intended(checker: Checker) -> None:
    checker.hold_object(BLOCK1)
    on_table = checker.at(0.5, -0.2, 0.475)
    assert not checker.is_free(on_table)
    checker.permit_contact(BLOCK1)
    assert checker.is_free(on_table)
    assert not checker.is_free(checker.at(0.5, -0.2, 0.475 - MAX_HELD_DEPTH_M - 0.002))


def test_objects_are_where_they_are_placed(checker: Checker) -> None:
    q = checker.at(0.7, 0.2, 0.55)
    positions, quaternions = np.zeros((3, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    positions[:] = [[0.5, 0.3, 0.475], [0.6, 0.3, 0.475], [0.5, -0.3, 0.5]]
    checker.place_bodies(positions, quaternions)
    assert checker.is_free(q)
    positions[PEG] = [0.7, 0.246, 0.5]
    checker.place_bodies(positions, quaternions)
    assert "'peg'" in checker.describe_collision(q)


@pytest.mark.parametrize("held", [None, BLOCK1])
def test_compiled_checks_agree_with_python_and_are_preloaded(puma: Cell, held: int | None) -> None:
    preload(collision)
    loaded = list(find_first_blocked.load_machine_code().signatures)  # type: ignore[attr-defined]
    checker, under_python = (CollisionChecker(puma, config("puma560")[1]) for _ in range(2))
    under_python._first_blocked = partial(find_first_blocked, *under_python._first_blocked.args)
    rng, decided = np.random.default_rng(4), set()
    for one in (checker, under_python):
        one.hold_object(held, (0.0, 0.0, 0.02), (0.0, 1.0, 0.0, 0.0))
    for q in puma.home + rng.normal(0.0, 0.6, (100, len(puma.home))):
        free = checker.is_free(q)
        assert under_python.is_free(q) == free == (checker.describe_collision(q) == "")
        assert np.array_equal(checker._data.qpos, under_python._data.qpos)
        decided.add(free)
    assert decided == {True, False}
    assert list(find_first_blocked.load_machine_code().signatures) == loaded  # type: ignore[attr-defined]


def test_a_close_pair_counts_even_if_its_bodies_have_several_geoms(puma: Cell) -> None:
    # Of bodies with several geoms MuJoCo's middle phase rules pairs out by margins of its own.
    usual, thorough = (CollisionChecker(puma, config("puma560")[1], 1e-3) for _ in range(2))
    thorough._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    rng, (low, high) = np.random.default_rng(1), puma.limits.position.T
    for q in rng.uniform(low, high, (20_000, len(low))):
        assert usual.is_free(q) == thorough.is_free(q), thorough.describe_collision(q)


@pytest.mark.parametrize("held", [None, BLOCK1])
def test_pairs_that_mujoco_skips_do_not_change_the_result(puma: Cell, held: int | None) -> None:
    checker, with_all = (CollisionChecker(puma, config("puma560")[1], 1e-3) for _ in range(2))
    for one in (checker, with_all):
        one.hold_object(held, (0.0, 0.0, 0.02), (0.0, 1.0, 0.0, 0.0))
    with_all._model.geom_contype[:] = with_all._model.geom_contype != 0
    with_all._model.geom_conaffinity[:] = 1
    rng, fewer = np.random.default_rng(5), 0
    for q in puma.home + rng.normal(0.0, 0.6, (300, len(puma.home))):
        assert checker.is_free(q) == with_all.is_free(q)
        assert checker.describe_worst_pair() == with_all.describe_worst_pair()
        fewer += checker._data.ncon < with_all._data.ncon
        assert checker.find_clearance(q) == with_all.find_clearance(q)
    assert fewer == (0 if held is None else 300)
