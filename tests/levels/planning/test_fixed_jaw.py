"""A jaw that stands still: a grasp brings it next to the object, whatever the object's width."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.levels.planning.fixed_jaw import GAP_M, FixedJaw, find_fixed_jaw
from rack.levels.planning.payload import Payloads
from rack.levels.planning.pose import Pose, pointing
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.task.program import DOWN
from tests.levels.arms import CLOCK_NS, cell
from tests.levels.robot import grippers

JAW_M = 0.025
"""From the tool of `grippers.one_finger` to its jaw, on the side of negative y."""


def jaw_of(made: Cell) -> FixedJaw | None:
    return find_fixed_jaw(made, Payloads(made, ("block1", "block2", "peg")))


def one_finger(folder: Path) -> Cell:
    arm = grippers.one_finger(folder)
    return build_cell(*arm, CLOCK_NS)


@pytest.mark.parametrize("half", [0.01, 0.02, 0.03])
def test_the_jaw_comes_next_to_an_object_of_any_width(tmp_path: Path, half: float) -> None:
    made = one_finger(tmp_path)
    geom = made.model.body_geomadr[made.bodies[0]]
    made.model.geom_size[geom] = half
    jaw = jaw_of(made)
    assert jaw is not None
    seen = Pose(np.array([0.5, 0.2, 0.475]), np.array([1.0, 0.0, 0.0, 0.0]))
    tool = Pose(seen.position, pointing(DOWN))
    moved = tool.inverse() @ jaw.beside(tool, 0, seen)
    assert moved.position == pytest.approx([0.0, JAW_M - half - GAP_M, 0.0], abs=2e-4)


def test_an_object_that_the_jaw_cannot_meet_is_taken_around_the_tool(tmp_path: Path) -> None:
    made = one_finger(tmp_path)
    jaw = jaw_of(made)
    assert jaw is not None
    tool = Pose(np.array([0.5, 0.2, 0.475]), pointing(DOWN))
    below = tool.raised(-0.2)
    assert jaw.beside(tool, 0, below) is tool


def test_fingers_that_both_move_have_no_fixed_jaw(tmp_path: Path) -> None:
    assert jaw_of(cell("puma560")) is None
    assert jaw_of(build_cell(*grippers.rotary(tmp_path), CLOCK_NS)) is None
