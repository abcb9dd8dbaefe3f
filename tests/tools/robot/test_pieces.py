"""Tests convex pieces of meshes: a bend that a hull would fill is free, and solid parts stay."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from rack.levels.robot.cell import build_cell, build_unchecked_cell
from rack.tools.robot.pieces import cut_meshes
from tests.levels.arms import CLOCK_NS
from tests.levels.robot import grippers

OUTLINE = ((0.0, 0.0), (0.03, 0.0), (0.03, 0.01), (0.01, 0.01), (0.01, 0.09), (0.0, 0.09))
"""A jaw, m: y and z of a plate of 90 mm with a foot of 30 mm."""
TRIANGLES = ((0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5))
IN_BEND, IN_PLATE, IN_FOOT = (0.015, 0.03), (0.005, 0.06), (0.022, 0.005)


def jaw() -> str:
    """Return the mesh of a jaw, 20 mm thick, as MJCF."""
    corners = [(x, y, z) for x in (-0.01, 0.01) for y, z in OUTLINE]
    count = len(OUTLINE)
    faces = [face[::-1] for face in TRIANGLES]
    faces += [(a + count, b + count, c + count) for a, b, c in TRIANGLES]
    for one in range(count):
        other = (one + 1) % count
        faces += [(one, other, other + count), (one, other + count, one + count)]
    vertex, face = (" ".join(str(k) for row in rows for k in row) for rows in (corners, faces))
    return f'<mesh name="jaw" vertex="{vertex}" face="{face}"/>'


def distance(model: mujoco.MjModel, place: tuple[float, float], prefix: str) -> float:
    """Return the distance, m, of a point in the frame of the jaw from solid meshes."""
    data = mujoco.MjData(model)
    probe = model.geom("probe").id
    mujoco.mj_forward(model, data)
    hand = model.body("hand").id
    at = np.array([0.0, place[0] - 0.066, place[1] + 0.06])
    data.geom_xpos[probe] = data.xpos[hand] + data.xmat[hand].reshape(3, 3) @ at
    solid = np.flatnonzero((model.geom_contype != 0) & (model.geom_bodyid == hand))
    meshes = [g for g in solid if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH]
    assert meshes, prefix
    return min(mujoco.mj_geomDistance(model, data, probe, int(g), 1.0, None) for g in meshes)


@pytest.mark.slow
def test_pieces_leave_the_bend_free_that_a_hull_fills(tmp_path: Path) -> None:
    robot, scene = grippers.one_finger(tmp_path)
    path = tmp_path / "puma560.xml"
    bent = '<geom name="bent" type="mesh" mesh="jaw" pos="0 -.066 .06"/>'
    probe = '<geom name="probe" size=".001" contype="0" conaffinity="0"/>'
    text = path.read_text().replace(grippers.FIXED, bent + probe)
    path.write_text(text.replace("<worldbody>", f"<asset>{jaw()}</asset><worldbody>", 1))
    whole = build_cell(robot, scene, CLOCK_NS)
    assert distance(whole.model, IN_BEND, "whole") < 0.0
    spec = mujoco.MjSpec.from_file(str(robot.model))
    spec.compile()
    cut_meshes(spec, build_unchecked_cell(robot, scene, CLOCK_NS), np.array([0.0, 0.0, -1.0]))
    cut = spec.compile()
    assert distance(cut, IN_BEND, "cut") > 0.003
    assert distance(cut, IN_PLATE, "cut") < 0.0
    assert distance(cut, IN_FOOT, "cut") < 0.0
    assert cut.body_mass == pytest.approx(whole.model.body_mass)
