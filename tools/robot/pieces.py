"""Meshes of a gripper as convex pieces: MuJoCo simulates a mesh by its hull, which fills the bend
of a jaw, and leaves no room for what one finger could take.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import Array
from rack.levels.robot.cell import Cell

PIECE_M = 0.008
"""Length of a piece along the jaws: across them a slice of a jaw is nearly convex."""
DIRECTIONS = 100
"""In which corners of a piece are sought: of thousands, those that span about the same hull."""
LEAST_M = 2e-4
"""What is thinner has no hull."""
KEPT = ("contype", "conaffinity", "condim", "priority", "group", "solmix")
KEPT_ROWS = ("friction", "solref", "solimp", "rgba")
"""What a piece has of its geom."""


def cut_meshes(spec: mujoco.MjSpec, cell: Cell, out: Array) -> int:
    """Cut what is solid of the gripper's meshes across the way `out`, (3,), of the closed gripper
    with the arm at its start; from then on the whole meshes are only seen. Return how many.
    """
    data = cell.start()
    assert cell.gripper is not None, "it has meshes"
    cell.gripper.linkage.set(data.qpos, cell.gripper.closed)
    mujoco.mj_kinematics(cell.model, data)
    count = 0
    # With the ids of the model, which additions change.
    for geom, number in [(geom, geom.id) for geom in spec.geoms]:
        is_solid = geom.contype or geom.conaffinity
        is_mesh = geom.type == mujoco.mjtGeom.mjGEOM_MESH
        if not (is_solid and is_mesh and number in cell.geoms.gripper):
            continue
        own = data.xmat[cell.model.geom_bodyid[number]].reshape(3, 3)
        corners, faces = _surface(cell.model, data, number)
        for piece in _pieces(corners, faces, own.T @ out):
            name = f"piece {len(spec.meshes)}"
            spec.add_mesh(name=name, uservert=piece.ravel())
            count += 1
            kind = mujoco.mjtGeom.mjGEOM_MESH
            added = geom.parent.add_geom(type=kind, meshname=name, mass=0.0)
            for key in KEPT:
                setattr(added, key, getattr(geom, key))
            for key in KEPT_ROWS:
                getattr(added, key)[:] = getattr(geom, key)
        geom.contype = geom.conaffinity = 0
    return count


def _surface(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int
) -> tuple[Array, NDArray[np.int32]]:
    """Return corners (n, 3), m, in the frame of the body, and faces (m, 3) of a mesh."""
    body = model.geom_bodyid[geom]
    own = data.xmat[body].reshape(3, 3).T
    turned = own @ data.geom_xmat[geom].reshape(3, 3)
    middle = own @ (data.geom_xpos[geom] - data.xpos[body])
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    corners = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    first = model.mesh_faceadr[mesh]
    faces = model.mesh_face[first : first + model.mesh_facenum[mesh]]
    return corners @ turned.T + middle, faces


def _pieces(corners: Array, faces: NDArray[np.int32], out: Array) -> list[Array]:
    """Return the corners of the convex pieces of a mesh, each (n, 3), m."""
    along = corners @ out
    edges = np.vstack((faces[:, :2], faces[:, 1:], faces[:, ::2]))

    def crossed(place: float) -> Array:
        """Return where edges cross a plane."""
        one, other = edges[np.prod(along[edges] - place, axis=1) < 0.0].T
        part = (place - along[one]) / (along[other] - along[one])
        return np.asarray(corners[one] + part[:, None] * (corners[other] - corners[one]))

    ways = np.random.default_rng(0).normal(size=(3, DIRECTIONS))
    found = []
    for low in np.arange(along.min(), along.max(), PIECE_M):
        inside = corners[(along >= low) & (along <= low + PIECE_M)]
        points = np.vstack((inside, crossed(low), crossed(low + PIECE_M)))
        if not len(points):
            continue
        points = points[np.unique((points @ ways).argmax(axis=0))]
        sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if len(points) > 3 and sizes[-1] > LEAST_M:
            found.append(points)
    return found
