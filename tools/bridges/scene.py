"""Converts the geoms of a MuJoCo model to a scene of Foxglove, each in the frame of its body."""

from __future__ import annotations

from functools import partial
from typing import Any

import mujoco
import numpy as np
from foxglove import messages as fox

from rack.levels.algebra import Array
from rack.tools.ecosystem.ros_messages import list_frames

Geom = mujoco.mjtGeom
CUBE = "cubes", fox.CubePrimitive
SPHERE = "spheres", fox.SpherePrimitive
CYLINDER = "cylinders", partial(fox.CylinderPrimitive, bottom_scale=1.0, top_scale=1.0)
SHAPES: dict[int, tuple[str, Any]] = {
    Geom.mjGEOM_BOX: CUBE,
    Geom.mjGEOM_PLANE: CUBE,
    Geom.mjGEOM_SPHERE: SPHERE,
    Geom.mjGEOM_ELLIPSOID: SPHERE,
    Geom.mjGEOM_CYLINDER: CYLINDER,
    # Foxglove has no capsules. Their ends are drawn flat, at their full length.
    Geom.mjGEOM_CAPSULE: CYLINDER,
}
"""Field of a `SceneEntity`, and its primitive, for each type of geom that a box encloses."""
SHOWN_GROUPS = 3
"""Number of geom groups that are shown. By convention, higher groups contain collision shapes."""
MAX_HALF_M = 2.0
"""Half size of an infinite plane, m."""


def build_scene(model: mujoco.MjModel) -> fox.SceneUpdate:
    """Return the visible geoms of a model. Height fields are left out."""
    entities = []
    frames = list_frames(model)
    for geom in np.flatnonzero(model.geom_group < SHOWN_GROUPS).tolist():
        material = model.geom_matid[geom]
        rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
        look: dict[str, Any] = {
            "pose": fox.Pose(
                position=_build(fox.Vector3, "xyz", model.geom_pos[geom]),
                orientation=_build(fox.Quaternion, "wxyz", model.geom_quat[geom]),
            ),
            "color": _build(fox.Color, "rgba", rgba),
        }
        kind = Geom(int(model.geom_type[geom]))
        if kind == Geom.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            points = model.mesh_vert[int(mesh.vertadr[0]) :][: int(mesh.vertnum[0])]
            faces = model.mesh_face[int(mesh.faceadr[0]) :][: int(mesh.facenum[0])]
            field, build_shape = "triangles", fox.TriangleListPrimitive
            look["points"] = [_build(fox.Point3, "xyz", point) for point in points]
            look["indices"] = faces.ravel().tolist()
        elif kind in SHAPES:
            field, build_shape = SHAPES[kind]
            size = 2.0 * np.minimum(model.geom_aabb[geom, 3:], MAX_HALF_M)
            size[2] *= kind != Geom.mjGEOM_PLANE
            look["size"] = _build(fox.Vector3, "xyz", size)
        else:
            continue
        shown: dict[str, Any] = {field: [build_shape(**look)]}
        entities.append(
            fox.SceneEntity(
                id=f"geom {geom}",
                frame_id=frames[model.geom_bodyid[geom]],
                frame_locked=True,
                **shown,
            )
        )
    return fox.SceneUpdate(entities=entities)


def _build(kind: Any, keys: str, values: Array) -> Any:
    """Build a message of Foxglove from the values of its fields, which have one-letter names."""
    return kind(**dict(zip(keys, values.tolist(), strict=True)))
