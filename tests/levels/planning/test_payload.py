"""Payloads too heavy for grip or motors are refused before anything moves, with both numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.levels.errors import Refused
from rack.levels.messages import Error, Verb
from rack.levels.planning.motion_planner import MotionPlanner
from rack.levels.planning.moves import Move, Situation
from rack.levels.planning.payload import Payloads
from rack.levels.planning.pose import Pose, make_pose
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.task.grasps import find_grasps
from tests.levels.arms import CLOCK_NS, cell, config, four_bar

ROBOT, SCENE = config("puma560")
BLOCK1, PEG = 0, 2


def weighing(kilograms: float) -> Cell:
    """Return the cell of the PUMA with another mass for block1."""
    made = cell("puma560")
    made.model.body_subtreemass[made.bodies[BLOCK1]] = kilograms
    return made


def situation_of(made: Cell) -> Situation:
    data = made.build_start_data()
    return Situation(data.xpos[made.bodies].copy(), data.xquat[made.bodies].copy())


def grip_of(made: Cell, row: int) -> Pose:
    """Return the grip of the first grasp of an object."""
    at = situation_of(made)
    return next(iter(find_grasps(made, at, row)))[0].inverse() @ at.object_pose(row)


@pytest.mark.parametrize("turn", [0.0, np.pi / 2])
def test_grip_is_weighed_against_friction_with_both_forces(turn: float) -> None:
    # 40 N at one finger are 20 N at each pad, whose friction is 1.2: 48 N.
    made = weighing(6.0)
    turned = grip_of(made, BLOCK1) @ make_pose(
        np.zeros(3), (np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2))
    )
    with pytest.raises(
        Refused, match=r"payload 'block1' 6 kg needs 88\.3 N of grip; the gripper holds 48\.0 N"
    ) as got:
        Payloads(made, SCENE.objects).check_grip(BLOCK1, turned)
    assert got.value.code == Error.OVERLOAD
    light = weighing(3.2)
    Payloads(light, SCENE.objects).check_grip(BLOCK1, turned)
    # What the fingers do not meet is not judged.
    aside = grip_of(made, BLOCK1) @ make_pose((0.3, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    Payloads(made, SCENE.objects).check_grip(BLOCK1, aside)


def test_thin_object_is_gripped_by_the_spring_of_the_position_loop() -> None:
    # 15 mm from closed, 2000 N/m: 30 N of the 40 N that the gripper has; 36 N of friction.
    made = cell("puma560")
    made.model.body_subtreemass[made.bodies[PEG]] = 3.5
    with pytest.raises(Refused, match=r"the gripper holds 36\.0 N"):
        Payloads(made, SCENE.objects).check_grip(PEG, grip_of(made, PEG))


def test_grip_of_a_linkage_follows_from_its_gear(tmp_path: Path) -> None:
    # The cranks, 50 mm, close on 50 mm near asin(0.5): 1 N m of each, 1 / (0.05 cos(pi/6)) N at its
    # pad.
    made = build_cell(*four_bar(tmp_path), CLOCK_NS)
    made.model.body_subtreemass[made.bodies[BLOCK1]] = 6.0
    with pytest.raises(Refused) as refused:
        Payloads(made, SCENE.objects).check_grip(BLOCK1, grip_of(made, BLOCK1))
    holds = float(str(refused.value).partition("holds ")[2].removesuffix(" N"))
    assert holds == pytest.approx(2 * 1.2 / (0.05 * np.cos(np.pi / 6)), rel=0.01)


def test_every_move_with_a_held_object_is_checked_for_its_weight() -> None:
    made = weighing(40.0)
    move = Move(
        1,
        0,
        Verb.MOVE_JOINTS,
        None,
        make_pose(np.zeros(3), (1.0, 0.0, 0.0, 0.0)),
        made.home + 0.3,
        False,
        0.0,
    )
    motion, empty = MotionPlanner(made, SCENE, 1990), situation_of(made)
    motion.plan(move, made.home, empty)
    with pytest.raises(
        Refused, match=r"payload 'block1' 40 kg needs \d+\.\d N m of 'j\d'; its motor carries"
    ) as got:
        motion.plan(move, made.home, empty.with_object_held(BLOCK1, grip_of(made, BLOCK1)))
    assert got.value.code == Error.OVERLOAD
