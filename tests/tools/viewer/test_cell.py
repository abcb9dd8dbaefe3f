"""Shapes of the view agree with MuJoCo's geometry, for every kind of geom."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from rack.tools.viewer.cell import STEP_RAD, subdivide_path
from rack.tools.viewer.shapes import build_shape, transform_to_body

MODEL = """
<mujoco>
  <asset>
    <mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/>
    <hfield name="hills" nrow="3" ncol="4" size="2 1 .5 .1"
           elevation="0 1 2 3  4 5 6 7  8 9 10 11"/>
    <material name="red" rgba="1 0 0 1"/>
  </asset>
  <worldbody>
    <geom name="plane" type="plane" size="0 3 .1"/>
    <geom name="hfield" type="hfield" hfield="hills" pos="0 0 -1"/>
    <body name="arm" pos="0 0 1">
      <joint axis="0 1 0"/>
      <geom name="capsule" type="capsule" fromto="0 0 0 .4 0 0" size=".03" material="red"/>
      <geom name="mesh" type="mesh" mesh="wedge" pos=".1 .2 .3" euler="30 40 50"/>
      <geom name="hidden" type="box" size=".1 .1 .1" rgba="1 1 1 0"/>
      <body name="hand" pos=".4 0 0">
        <geom name="box" type="box" size=".1 .2 .3" pos="0 0 .1" euler="0 0 90"/>
        <geom name="sphere" size=".1"/>
        <geom name="ellipsoid" type="ellipsoid" size=".1 .2 .3"/>
        <geom name="cylinder" type="cylinder" size=".1 .2" rgba="0 1 0 .5"/>
      </body>
    </body>
    <body name="post" mocap="true"><geom name="post" size=".1"/></body>
    <body name="shelf" pos="1 0 0"><geom name="shelf" size=".1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL)


def column(model: mujoco.MjModel, geom: str, name: str) -> np.ndarray:
    """Return one component of a geom's shape, one row per instance."""
    shape = build_shape(model, model.geom(geom).id)
    assert shape is not None
    batches = {
        b.component_descriptor().component.partition(":")[2]: b
        for b in shape.as_component_batches()
    }
    return np.array(batches[name].as_arrow_array().to_pylist())


def test_every_kind_of_geom_has_a_shape(model: mujoco.MjModel) -> None:
    without = [model.geom(g).name for g in range(model.ngeom) if build_shape(model, g) is None]
    assert without == ["hidden"]


def test_a_capsule_begins_and_ends_where_mujocos_does(model: mujoco.MjModel) -> None:
    begin = column(model, "capsule", "translations")[0]
    x, y, z, w = column(model, "capsule", "quaternions")[0]
    axis = np.zeros(3)
    mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), np.array([w, x, y, z]))
    end = begin + axis * column(model, "capsule", "lengths")[0]
    assert np.sort([begin, end], axis=0) == pytest.approx(
        np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]]), abs=1e-6
    )


def test_a_mesh_lies_where_its_file_says_though_mujoco_recentres_it(model: mujoco.MjModel) -> None:
    corners = np.unique(np.round(column(model, "mesh", "vertex_positions"), 5), axis=0)
    rotation = np.zeros(9)
    quaternion = np.zeros(4)
    mujoco.mju_euler2Quat(quaternion, np.radians([30, 40, 50]), "xyz")
    mujoco.mju_quat2Mat(rotation, quaternion)
    given = np.vstack((np.zeros(3), np.eye(3))) @ rotation.reshape(3, 3).T + [0.1, 0.2, 0.3]
    assert corners == pytest.approx(np.unique(np.round(given, 5), axis=0), abs=2e-5)


def test_points_of_a_geom_are_placed_as_mujoco_places_them(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    data.qpos[0] = 0.7
    mujoco.mj_kinematics(model, data)
    geom, point = model.geom("box").id, np.array([[0.1, 0.2, 0.3]])
    expected = data.geom_xpos[geom] + data.geom_xmat[geom].reshape(3, 3) @ point[0]
    body = model.geom_bodyid[geom]
    in_body = transform_to_body(model, geom, point)[0]
    assert data.xpos[body] + data.xmat[body].reshape(3, 3) @ in_body == pytest.approx(expected)


def test_a_path_is_drawn_in_small_pieces_through_its_corners() -> None:
    corners = np.array([[0.0, 0.0], [0.1, -0.2], [0.1, -0.2], [0.3, 0.0]])
    points = subdivide_path(corners)
    assert np.abs(np.diff(points, axis=0)).max() <= STEP_RAD + 1e-12
    assert all((points == corner).all(axis=1).any() for corner in corners)
