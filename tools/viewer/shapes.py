"""One MuJoCo geom as a shape in the frame of its body."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Shape = Callable[[mujoco.MjModel, int], rr.AsComponents]

Geom = mujoco.mjtGeom


def shape_of(model: mujoco.MjModel, geom: int) -> rr.AsComponents | None:
    """Return the shape of a geom; None for one that is invisible."""
    shape = SHAPES.get(Geom(int(model.geom_type[geom])))
    return None if shape is None or colour(model, geom)[3] == 0 else shape(model, geom)


def colour(model: mujoco.MjModel, geom: int) -> NDArray[np.uint8]:
    """Return red, green, blue, alpha of a geom, 0 to 255: its material's, where it has one."""
    material = model.geom_matid[geom]
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    return np.asarray(np.round(rgba * 255), dtype=np.uint8)


def xyzw(quaternions: Floats) -> Floats:
    """Return MuJoCo's quaternions, w first, as rerun's, w last; shape (..., 4)."""
    return np.roll(quaternions, -1, axis=-1)


def _solid(model: mujoco.MjModel, geom: int) -> dict[str, Any]:
    """Return orientation and colour of a solid geom."""
    return {
        "quaternions": [xyzw(model.geom_quat[geom])],
        "colors": [colour(model, geom)],
        "fill_mode": "solid",
    }


def _centred(model: mujoco.MjModel, geom: int) -> dict[str, Any]:
    """Return the same, and the centre of the solid."""
    return {"centers": [model.geom_pos[geom]], **_solid(model, geom)}


def _box(model: mujoco.MjModel, geom: int) -> rr.AsComponents:
    return rr.Boxes3D(half_sizes=[model.geom_size[geom]], **_centred(model, geom))


def _sphere(model: mujoco.MjModel, geom: int) -> rr.AsComponents:
    radius = model.geom_size[geom][0]
    return rr.Ellipsoids3D(half_sizes=[[radius] * 3], **_centred(model, geom))


def _ellipsoid(model: mujoco.MjModel, geom: int) -> rr.AsComponents:
    return rr.Ellipsoids3D(half_sizes=[model.geom_size[geom]], **_centred(model, geom))


def _cylinder(model: mujoco.MjModel, geom: int) -> rr.AsComponents:
    radius, half, _ = model.geom_size[geom]
    return rr.Cylinders3D(lengths=[2 * half], radii=[radius], **_centred(model, geom))


def _capsule(model: mujoco.MjModel, geom: int) -> rr.AsComponents:
    radius, half, _ = model.geom_size[geom]
    # MuJoCo's capsule is centred; rerun's begins at its origin.
    begin = placed(model, geom, np.array([[0.0, 0.0, -half]]))
    return rr.Capsules3D(
        lengths=[2 * half], radii=[radius], translations=begin, **_solid(model, geom)
    )


def _plane(model: mujoco.MjModel, geom: int) -> rr.AsComponents:
    # A half size of zero is an endless plane: as large as what stands on it.
    x, y = (size or 2 * model.stat.extent for size in model.geom_size[geom][:2])
    corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    return _surface(model, geom, corners, np.array([[0, 1, 2], [0, 2, 3]]))


def _mesh(model: mujoco.MjModel, geom: int) -> rr.AsComponents:
    mesh = model.geom_dataid[geom]
    vertices = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
    faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
    return _surface(model, geom, model.mesh_vert[vertices].astype(float), model.mesh_face[faces])


def _height_field(model: mujoco.MjModel, geom: int) -> rr.AsComponents:
    field = model.geom_dataid[geom]
    rows = model.hfield_nrow[field]
    columns = model.hfield_ncol[field]
    start = model.hfield_adr[field]
    half_x, half_y, top, _ = model.hfield_size[field]
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    z = model.hfield_data[start : start + rows * columns] * top
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    corners = first[:, None] + np.array([[0, 1, columns + 1, 0, columns + 1, columns]])
    return _surface(model, geom, np.column_stack((x.ravel(), y.ravel(), z)), corners.reshape(-1, 3))


def _surface(
    model: mujoco.MjModel, geom: int, vertices: Floats, triangles: NDArray[np.integer]
) -> rr.AsComponents:
    # Flat shading: every triangle has corners of its own, so that an edge stays an edge.
    corners = placed(model, geom, vertices)[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(length > 0, length, 1.0)
    return rr.Mesh3D(
        vertex_positions=corners.reshape(-1, 3),
        triangle_indices=np.arange(3 * len(corners)).reshape(-1, 3),
        vertex_normals=np.repeat(normals, 3, axis=0),
        albedo_factor=colour(model, geom),
    )


def placed(model: mujoco.MjModel, geom: int, points: Floats) -> Floats:
    """Return points of a geom's frame in the frame of its body, (points, 3), m."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    return np.asarray(model.geom_pos[geom] + points @ rotation.reshape(3, 3).T)


SHAPES: dict[mujoco.mjtGeom, Shape] = {
    Geom.mjGEOM_PLANE: _plane,
    Geom.mjGEOM_HFIELD: _height_field,
    Geom.mjGEOM_SPHERE: _sphere,
    Geom.mjGEOM_CAPSULE: _capsule,
    Geom.mjGEOM_ELLIPSOID: _ellipsoid,
    Geom.mjGEOM_CYLINDER: _cylinder,
    Geom.mjGEOM_BOX: _box,
    Geom.mjGEOM_MESH: _mesh,
    Geom.mjGEOM_SDF: _mesh,
}
