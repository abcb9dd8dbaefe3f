"""The cell's geometry: every geom once, in the frame of its body; what moves are the frames alone."""

from __future__ import annotations

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from rack.tools.viewer.shapes import shape_of, xyzw
from rack.tools.viewer.stream import Stream

CELL, COLLISION = "cell", "collision"
WORLD = "world"
SHOWN_GROUPS = 3
"""MuJoCo's own viewer shows groups 0, 1, 2; those above hold collision shapes, by custom."""


def frame_of(model: mujoco.MjModel, body: int) -> str:
    """Return the name of a body's frame."""
    return WORLD if body == 0 else f"body/{model.body(body).name or body}"


def moving_bodies(model: mujoco.MjModel) -> NDArray[np.int_]:
    """Return the bodies that joints or their own will move, and all that hang on them."""
    moves = np.zeros(model.nbody, dtype=bool)
    for body in range(1, model.nbody):  # parents come first
        own = model.body_jntnum[body] > 0 or model.body_mocapid[body] >= 0
        moves[body] = own or moves[model.body_parentid[body]]
    return np.flatnonzero(moves)


def write_geometry(stream: Stream, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Log all geoms, and the frames that never move as `data` has them."""
    stream.static((CELL,), rr.CoordinateFrame(WORLD))
    shown = {geom: _is_shown(model, geom) for geom in range(model.ngeom)}
    for geom in shown:
        shape = shape_of(model, geom)
        if shape is not None:
            entity = _entity(model, geom, shown[geom] or not any(shown.values()))
            stream.static(entity, shape, rr.CoordinateFrame(frame_of(model, int(model.geom_bodyid[geom]))))
    for body in set(range(1, model.nbody)) - set(moving_bodies(model).tolist()):
        pose = rr.Transform3D(
            translation=data.xpos[body],
            quaternion=rr.Quaternion(xyzw=xyzw(data.xquat[body])),
            parent_frame=WORLD,
            child_frame=frame_of(model, body),
        )
        stream.static(("frames", frame_of(model, body)), pose)


def _is_shown(model: mujoco.MjModel, geom: int) -> bool:
    return bool(model.geom_group[geom] < SHOWN_GROUPS)


def _entity(model: mujoco.MjModel, geom: int, shown: bool) -> tuple[str, ...]:
    body = model.body(int(model.geom_bodyid[geom])).name or f"body {model.geom_bodyid[geom]}"
    name = model.geom(geom).name or f"geom {geom}"
    return (CELL, *(() if shown else (COLLISION,)), body, name)
