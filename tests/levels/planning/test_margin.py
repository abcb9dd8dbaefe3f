"""Planning keeps a margin that the checks of the simulated arm do not have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.levels.planning.collision import CollisionChecker
from rack.levels.planning.motion_planner import MAX_DEVIATION_M, MotionPlanner
from rack.levels.planning.moves import Situation
from rack.levels.planning.payload import GAP_M, FixedJaw, Payloads, find_fixed_jaw
from rack.levels.planning.pose import Pose, build_pointing_quaternion
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.tables import SceneConfig
from rack.levels.task.actions import TransferPlanner
from rack.levels.task.program import DOWN
from rack.levels.task.rehearsal import Rehearsal
from tests.levels.arms import CLOCK_NS, cell, pendulum
from tests.levels.robot import grippers

STOP = '<geom name="post" type="box" size=".01 .01 .01" pos=".2 0 {z}"/>'
TOP_M = 0.7 + 0.03 + 0.01  # of the upper arm at home, and half of the post


def hinged(folder: Path, apart: float) -> tuple[Cell, SceneConfig]:
    """Return a two-joint arm whose carrier ends `apart`, m, above its first link at home."""
    robot = pendulum(folder)
    text = robot.model.read_text()
    carrier = f'<body name="base">{STOP.format(z=TOP_M + apart)}<body name="upper"'
    text = text.replace('<body name="upper"', carrier).replace(
        "</worldbody>", "</body></worldbody>"
    )
    robot.model.write_text(text)
    return build_cell(robot, SceneConfig(), CLOCK_NS), SceneConfig()


def test_links_keep_the_margin_only_in_planning(tmp_path: Path) -> None:
    made, scene = hinged(tmp_path, 0.004)
    lifted = np.array([-0.0032 / 0.2, 0.5])  # 0.8 mm are left
    assert CollisionChecker(made, scene).is_free(lifted)
    planned = CollisionChecker(made, scene, MAX_DEVIATION_M)
    assert planned.is_free(made.home)
    assert not planned.is_free(lifted)
    assert 0.0 < planned.find_clearance(lifted) < MAX_DEVIATION_M
    assert planned.is_free(lifted, planned.find_clearance(lifted))


def lowest_grasp(folder: Path, length: float) -> float:
    """Return the height, m, above its origin at which block1 is taken with fingers of `length`,
    m."""
    robot, scene = grippers.rotary(folder)
    model = folder / "puma560.xml"
    pad = f'size=".012 .006 {length / 2}" pos="0 0 {0.01 + length / 2}"'
    model.write_text(model.read_text().replace('size=".012 .006 .04" pos="0 0 .05"', pad))
    made = build_cell(robot, scene, CLOCK_NS)
    poses = made.build_start_data().qpos[made.object_qpos[:, None] + np.arange(7)]
    situation = Situation(poses[:, :3].copy(), poses[:, 3:].copy())
    rehearsal = Rehearsal(MotionPlanner(made, scene, 1), made.home, situation)
    takes = next(TransferPlanner(rehearsal, 0, 0.1).find_pick_spots())
    return float(takes[0].tool.position[2] - situation.positions[0, 2])


@pytest.mark.parametrize(("length", "height"), [(0.08, 0.0), (0.098, 0.01)])
def test_a_grasp_leaves_room_for_fingers_that_reach_farther_as_they_close(
    tmp_path: Path, length: float, height: float
) -> None:
    assert lowest_grasp(tmp_path, length) == pytest.approx(height)


JAW_M = 0.025
"""Distance from the tool of `grippers.one_finger` to its jaw, on the negative y side."""


def jaw_of(made: Cell) -> FixedJaw | None:
    return find_fixed_jaw(made, Payloads(made, ("block1", "block2", "peg")))


def one_finger(folder: Path) -> Cell:
    arm = grippers.one_finger(folder)
    return build_cell(*arm, CLOCK_NS)


@pytest.mark.parametrize("half", [0.01, 0.02, 0.03])
def test_the_jaw_is_placed_next_to_an_object_of_any_width(tmp_path: Path, half: float) -> None:
    made = one_finger(tmp_path)
    geom = made.model.body_geomadr[made.bodies[0]]
    made.model.geom_size[geom] = half
    jaw = jaw_of(made)
    assert jaw is not None
    seen = Pose(np.array([0.5, 0.2, 0.475]), np.array([1.0, 0.0, 0.0, 0.0]))
    tool = Pose(seen.position, build_pointing_quaternion(DOWN))
    moved = tool.inverse() @ jaw.move_beside(tool, 0, seen)
    assert moved.position == pytest.approx([0.0, JAW_M - half - GAP_M, 0.0], abs=2e-4)


def test_an_object_that_the_jaw_cannot_meet_does_not_move_the_tool(tmp_path: Path) -> None:
    made = one_finger(tmp_path)
    jaw = jaw_of(made)
    assert jaw is not None
    tool = Pose(np.array([0.5, 0.2, 0.475]), build_pointing_quaternion(DOWN))
    below = tool.raise_by(-0.2)
    assert jaw.move_beside(tool, 0, below) is tool


def test_fingers_that_both_move_have_no_fixed_jaw(tmp_path: Path) -> None:
    assert jaw_of(cell("puma560")) is None
    assert jaw_of(build_cell(*grippers.rotary(tmp_path), CLOCK_NS)) is None
