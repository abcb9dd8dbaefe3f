"""Cuts the meshes of a gripper into convex pieces.

MuJoCo simulates a mesh by its convex hull. The hull of a bent jaw fills its bend and leaves no gap
for an object between jaw and finger.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import Array
from rack.levels.robot.cell import Cell

PIECE_M = 0.008
"""Length of a piece along the jaws. A slice across a jaw is nearly convex."""
DIRECTIONS = 100
"""Number of directions in which extreme points are kept. They span about the same hull as all."""
MIN_THICKNESS_M = 2e-4
"""Thinner pieces are dropped, because they have no hull."""
INHERITED = ("contype", "conaffinity", "condim", "priority", "group", "solmix")
INHERITED_ARRAYS = ("friction", "solref", "solimp", "rgba")
"""Properties that a piece inherits from its geom."""


def cut_meshes(spec: mujoco.MjSpec, cell: Cell, out: Array) -> int:
    """Cut the solid meshes of a gripper into convex pieces. The whole meshes remain visible.

    Args:
        spec: The model, which is changed.
        cell: The same model, compiled, with its arm at the start.
        out: Direction out of the closed hand, (3,). The cuts are perpendicular to it.

    Returns:
        The number of pieces.
    """
    data = cell.build_start_data()
    assert cell.gripper is not None, "it has meshes"
    cell.gripper.linkage.set_opening(data.qpos, cell.gripper.closed)
    mujoco.mj_kinematics(cell.model, data)
    count = 0
    # Collect the ids of the geoms first, because adding geoms changes them.
    for geom, geom_id in [(geom, geom.id) for geom in spec.geoms]:
        is_solid = geom.contype or geom.conaffinity
        is_mesh = geom.type == mujoco.mjtGeom.mjGEOM_MESH
        if not (is_solid and is_mesh and geom_id in cell.geoms.gripper):
            continue
        body_axes = data.xmat[cell.model.geom_bodyid[geom_id]].reshape(3, 3)
        corners, faces = _read_surface(cell.model, data, geom_id)
        for piece in _slice_mesh(corners, faces, body_axes.T @ out):
            name = f"piece {len(spec.meshes)}"
            spec.add_mesh(name=name, uservert=piece.ravel())
            count += 1
            mesh_type = mujoco.mjtGeom.mjGEOM_MESH
            added = geom.parent.add_geom(type=mesh_type, meshname=name, mass=0.0)
            for key in INHERITED:
                setattr(added, key, getattr(geom, key))
            for key in INHERITED_ARRAYS:
                getattr(added, key)[:] = getattr(geom, key)
        geom.contype = geom.conaffinity = 0
    return count


def _read_surface(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int
) -> tuple[Array, NDArray[np.int32]]:
    """Return the surface of a mesh in the frame of its body.

    Returns:
        Vertices, (n, 3), in m, and the vertex numbers of the faces, (m, 3).
    """
    body = model.geom_bodyid[geom]
    world_to_body = data.xmat[body].reshape(3, 3).T
    rotation = world_to_body @ data.geom_xmat[geom].reshape(3, 3)
    offset = world_to_body @ (data.geom_xpos[geom] - data.xpos[body])
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    corners = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    first = model.mesh_faceadr[mesh]
    faces = model.mesh_face[first : first + model.mesh_facenum[mesh]]
    return corners @ rotation.T + offset, faces


def _slice_mesh(corners: Array, faces: NDArray[np.int32], out: Array) -> list[Array]:
    """Cut a mesh into slices, and return the vertices of each, (n, 3), in m.

    Args:
        corners: Vertices of the mesh, (n, 3), in m.
        faces: Vertex numbers of the triangles, (m, 3).
        out: Direction perpendicular to the cuts, (3,).
    """
    along = corners @ out
    edges = np.vstack((faces[:, :2], faces[:, 1:], faces[:, ::2]))

    def find_crossings(place: float) -> Array:
        """Return the points at which edges cross the plane at position `place` along `out`."""
        start, end = edges[np.prod(along[edges] - place, axis=1) < 0.0].T
        fraction = (place - along[start]) / (along[end] - along[start])
        return np.asarray(corners[start] + fraction[:, None] * (corners[end] - corners[start]))

    directions = np.random.default_rng(0).normal(size=(3, DIRECTIONS))
    pieces = []
    for low in np.arange(along.min(), along.max(), PIECE_M):
        inside = corners[(along >= low) & (along <= low + PIECE_M)]
        points = np.vstack((inside, find_crossings(low), find_crossings(low + PIECE_M)))
        if not len(points):
            continue
        points = points[np.unique((points @ directions).argmax(axis=0))]
        sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if len(points) > 3 and sizes[-1] > MIN_THICKNESS_M:
            pieces.append(points)
    return pieces
