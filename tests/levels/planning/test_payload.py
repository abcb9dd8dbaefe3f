"""Payloads too heavy are refused before anything moves; planning keeps a margin around objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.levels.errors import Refused
from rack.levels.messages import Error, Verb
from rack.levels.planning.collision import CollisionChecker
from rack.levels.planning.motion_planner import MAX_DEVIATION_M, MotionPlanner
from rack.levels.planning.moves import Move
from rack.levels.planning.payload import GAP_M, FixedJaw, Payloads, find_fixed_jaw
from rack.levels.planning.pose import Pose, build_pointing_quaternion, make_pose
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.tables import SceneConfig
from rack.levels.task.actions import TransferPlanner
from rack.levels.task.grasps import find_grasps
from rack.levels.task.program import DOWN
from rack.levels.task.rehearsal import Rehearsal
from tests.levels.arms import CLOCK_NS, cell, config, find_situation, pendulum
from tests.levels.robot import grippers

ROBOT, SCENE = config("puma560")
BLOCK1, PEG = 0, 2


def weighing(kilograms: float) -> Cell:
    """Return the cell of the PUMA with another mass for block1."""
    made = cell("puma560")
    made.model.body_subtreemass[made.bodies[BLOCK1]] = kilograms
    return made


def grip_of(made: Cell, row: int) -> Pose:
    """Return the grip of the first grasp of an object."""
    at = find_situation(made)
    return next(iter(find_grasps(made, at, row)))[0].inverse() @ at.object_pose(row)


@pytest.mark.parametrize("turn", [0.0, np.pi / 2])
def test_grip_is_weighed_against_friction_with_both_forces(turn: float) -> None:
    # 40 N at one finger are 20 N at each pad, whose friction is 1.2: 48 N.
    made = weighing(6.0)
    yaw = make_pose(np.zeros(3), (np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)))
    turned = grip_of(made, BLOCK1) @ yaw
    why = r"payload 'block1' 6 kg needs 88\.3 N of grip; the gripper holds 48\.0 N"
    with pytest.raises(Refused, match=why) as got:
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
    # The cranks, 50 mm, close on 50 mm near asin(0.5): of 1 N m each, 1 / (0.05 cos(pi/6)) N.
    made = build_cell(*grippers.four_bar(tmp_path), CLOCK_NS)
    made.model.body_subtreemass[made.bodies[BLOCK1]] = 6.0
    with pytest.raises(Refused) as refused:
        Payloads(made, SCENE.objects).check_grip(BLOCK1, grip_of(made, BLOCK1))
    holds = float(str(refused.value).partition("holds ")[2].removesuffix(" N"))
    assert holds == pytest.approx(2 * 1.2 / (0.05 * np.cos(np.pi / 6)), rel=0.01)


def test_every_move_with_a_held_object_is_checked_for_its_weight() -> None:
    made = weighing(40.0)
    pose = make_pose(np.zeros(3), (1.0, 0.0, 0.0, 0.0))
    move = Move(1, 0, Verb.MOVE_JOINTS, None, pose, made.home + 0.3, False, 0.0)
    motion, empty = MotionPlanner(made, SCENE, 1990), find_situation(made)
    motion.plan(move, made.home, empty)
    why = r"payload 'block1' 40 kg needs \d+\.\d N m of 'j\d'; its motor carries"
    with pytest.raises(Refused, match=why) as got:
        motion.plan(move, made.home, empty.with_object_held(BLOCK1, grip_of(made, BLOCK1)))
    assert got.value.code == Error.OVERLOAD


def test_links_keep_the_margin_only_in_planning(tmp_path: Path) -> None:
    # The carrier of a two-joint arm ends 4 mm above its first link at home.
    robot, scene = pendulum(tmp_path), SceneConfig()
    z = 0.7 + 0.03 + 0.01 + 0.004  # of the upper arm at home, half of the post, and 4 mm
    post = f'<geom name="post" type="box" size=".01 .01 .01" pos=".2 0 {z}"/>'
    text = robot.model.read_text()
    text = text.replace('<body name="upper"', f'<body name="base">{post}<body name="upper"')
    robot.model.write_text(text.replace("</worldbody>", "</body></worldbody>"))
    made = build_cell(robot, scene, CLOCK_NS)
    lifted = np.array([-0.0032 / 0.2, 0.5])  # 0.8 mm are left
    assert CollisionChecker(made, scene).is_free(lifted)
    planned = CollisionChecker(made, scene, MAX_DEVIATION_M)
    assert planned.is_free(made.home)
    assert not planned.is_free(lifted)
    assert 0.0 < planned.find_clearance(lifted) < MAX_DEVIATION_M
    assert planned.is_free(lifted, planned.find_clearance(lifted))


@pytest.mark.parametrize(("length", "height"), [(0.08, 0.0), (0.098, 0.01)])
def test_a_grasp_has_room_for_closing_fingers(tmp_path: Path, length: float, height: float) -> None:
    robot, scene = grippers.rotary(tmp_path)
    model = tmp_path / "puma560.xml"
    pad = f'size=".012 .006 {length / 2}" pos="0 0 {0.01 + length / 2}"'
    model.write_text(model.read_text().replace('size=".012 .006 .04" pos="0 0 .05"', pad))
    made = build_cell(robot, scene, CLOCK_NS)
    situation = find_situation(made)
    rehearsal = Rehearsal(MotionPlanner(made, scene, 1), made.home, situation)
    takes = next(TransferPlanner(rehearsal, 0, 0.1).find_pick_spots())
    assert takes[0].tool.position[2] - situation.positions[0, 2] == pytest.approx(height)


JAW_M = 0.025
"""Distance from the tool of `grippers.one_finger` to its jaw, on the negative y side."""


def jaw_of(made: Cell) -> FixedJaw | None:
    return find_fixed_jaw(made, Payloads(made, ("block1", "block2", "peg")))


@pytest.mark.parametrize("half", [0.01, 0.02, 0.03])
def test_the_jaw_is_placed_next_to_an_object_of_any_width(tmp_path: Path, half: float) -> None:
    made = build_cell(*grippers.one_finger(tmp_path), CLOCK_NS)
    geom = made.model.body_geomadr[made.bodies[0]]
    made.model.geom_size[geom] = half
    jaw = jaw_of(made)
    assert jaw is not None
    seen = Pose(np.array([0.5, 0.2, 0.475]), np.array([1.0, 0.0, 0.0, 0.0]))
    tool = Pose(seen.position, build_pointing_quaternion(DOWN))
    moved = tool.inverse() @ jaw.move_beside(tool, 0, seen)
    assert moved.position == pytest.approx([0.0, JAW_M - half - GAP_M, 0.0], abs=2e-4)


def test_an_object_that_the_jaw_cannot_meet_does_not_move_the_tool(tmp_path: Path) -> None:
    jaw = jaw_of(build_cell(*grippers.one_finger(tmp_path), CLOCK_NS))
    assert jaw is not None
    tool = Pose(np.array([0.5, 0.2, 0.475]), build_pointing_quaternion(DOWN))
    below = tool.raise_by(-0.2)
    assert jaw.move_beside(tool, 0, below) is tool


def test_fingers_that_both_move_have_no_fixed_jaw(tmp_path: Path) -> None:
    assert jaw_of(cell("puma560")) is None
    assert jaw_of(build_cell(*grippers.rotary(tmp_path), CLOCK_NS)) is None
