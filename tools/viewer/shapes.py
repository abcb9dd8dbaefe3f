"""Converts MuJoCo geoms to shapes of the viewer, in the frame of their body."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from rack.levels.algebra import Array

Geom = mujoco.mjtGeom
Shape = rr.Boxes3D | rr.Ellipsoids3D | rr.Cylinders3D | rr.Capsules3D | rr.Mesh3D


def colour_shape(shape: Shape, colour: Any) -> Shape:
    """Return an archetype that changes only the colour of a shape, which must not be static."""
    if isinstance(shape, rr.Mesh3D):
        return rr.Mesh3D.from_fields(albedo_factor=colour)
    return type(shape).from_fields(colors=[colour])


def remove_colour(shape: Shape) -> None:
    """Remove the colour of a shape, so that the rest of it can be static."""
    setattr(shape, "albedo_factor" if isinstance(shape, rr.Mesh3D) else "colors", None)


def build_shape(model: mujoco.MjModel, geom: int) -> Shape | None:
    """Return the shape of a geom. None if the geom is invisible or of an unknown type."""
    rgba = read_colour(model, geom)
    if rgba[3] == 0:
        return None
    size = model.geom_size[geom]
    radius, half, _ = size
    solid: dict[str, Any] = {
        "quaternions": [convert_to_xyzw(model.geom_quat[geom])],
        "colors": [rgba],
        "fill_mode": "solid",
    }
    centred = {"centers": [model.geom_pos[geom]], **solid}
    match Geom(int(model.geom_type[geom])):
        case Geom.mjGEOM_BOX:
            return rr.Boxes3D(half_sizes=[size], **centred)
        case Geom.mjGEOM_SPHERE | Geom.mjGEOM_ELLIPSOID:
            return rr.Ellipsoids3D(half_sizes=[model.geom_aabb[geom, 3:]], **centred)
        case Geom.mjGEOM_CYLINDER:
            return rr.Cylinders3D(lengths=[2 * half], radii=[radius], **centred)
        case Geom.mjGEOM_CAPSULE:
            # The origin of a capsule is its centre in MuJoCo, but one of its ends in rerun.
            begin = transform_to_body(model, geom, np.array([[0.0, 0.0, -half]]))
            return rr.Capsules3D(lengths=[2 * half], radii=[radius], translations=begin, **solid)
        case Geom.mjGEOM_PLANE:
            # A half size of zero means an infinite plane. Draw it larger than the model.
            sides = [half_size or 2 * model.stat.extent for half_size in size[:2]]
            return rr.Boxes3D(half_sizes=[(*sides, 0.0)], **centred)
        case Geom.mjGEOM_MESH | Geom.mjGEOM_SDF:
            return _build_mesh(model, geom)
        case Geom.mjGEOM_HFIELD:
            return _build_height_field(model, geom)
    return None


def read_colour(model: mujoco.MjModel, geom: int) -> NDArray[np.uint8]:
    """Return red, green, blue and alpha (0 to 255) of a geom's material or of the geom itself."""
    material = model.geom_matid[geom]
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    return np.asarray(np.round(rgba * 255), dtype=np.uint8)


def convert_to_xyzw(quaternions: Array) -> Array:
    """Convert quaternions of shape (..., 4) from MuJoCo's order, w first, to rerun's, w last."""
    return np.roll(quaternions, -1, axis=-1)


def _build_mesh(model: mujoco.MjModel, geom: int) -> Shape:
    """Return the shape of a mesh or signed distance field, which consists of triangles."""
    mesh = model.geom_dataid[geom]
    vertices = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
    faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
    return _build_surface(
        model, geom, model.mesh_vert[vertices].astype(float), model.mesh_face[faces]
    )


def _build_height_field(model: mujoco.MjModel, geom: int) -> Shape:
    """Return the shape of a height field, which consists of triangles."""
    field = model.geom_dataid[geom]
    rows = model.hfield_nrow[field]
    columns = model.hfield_ncol[field]
    start = model.hfield_adr[field]
    half_x, half_y, top, _ = model.hfield_size[field]
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    z = model.hfield_data[start : start + rows * columns] * top
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    corners = first[:, None] + np.array([[0, 1, columns + 1, 0, columns + 1, columns]])
    return _build_surface(
        model, geom, np.column_stack((x.ravel(), y.ravel(), z)), corners.reshape(-1, 3)
    )


def _build_surface(
    model: mujoco.MjModel, geom: int, vertices: Array, triangles: NDArray[np.integer]
) -> Shape:
    """Return triangles as a mesh with flat shading.

    Args:
        model: The model.
        geom: The geom that consists of these triangles. It determines their pose and colour.
        vertices: Positions in m in the frame of the geom, shape (n, 3).
        triangles: Indices of the vertices of each triangle, shape (triangles, 3).
    """
    # Flat shading: each triangle has its own corners and normals, so that edges look sharp.
    corners = transform_to_body(model, geom, vertices)[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(length > 0, length, 1.0)
    return rr.Mesh3D(
        vertex_positions=corners.reshape(-1, 3),
        triangle_indices=np.arange(3 * len(corners)).reshape(-1, 3),
        vertex_normals=np.repeat(normals, 3, axis=0),
        albedo_factor=read_colour(model, geom),
    )


def transform_to_body(model: mujoco.MjModel, geom: int, points: Array) -> Array:
    """Transform points from the frame of a geom to the frame of its body.

    Args:
        model: The model.
        geom: The geom.
        points: Positions in m, shape (points, 3).
    """
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    return np.asarray(model.geom_pos[geom] + points @ rotation.reshape(3, 3).T)
