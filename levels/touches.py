"""Which contacts a task means, and which are touches."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray


def geoms_of(model: mujoco.MjModel, bodies: NDArray[np.bool_]) -> NDArray[np.int_]:
    """Return the ids of the geoms on the bodies marked (nbody,)."""
    return np.flatnonzero(bodies[model.geom_bodyid])


def below(model: mujoco.MjModel, roots: NDArray[np.int_]) -> NDArray[np.bool_]:
    """Mark (nbody,) the bodies `roots` and all that hang on them."""
    marked = np.zeros(model.nbody, dtype=bool)
    marked[roots] = True
    for body in range(1, model.nbody):
        marked[body] |= marked[model.body_parentid[body]]
    return marked


def touch_matrix(
    model: mujoco.MjModel,
    arm: NDArray[np.int_],
    gripper: NDArray[np.int_],
    objects: NDArray[np.int_],
    supports: NDArray[np.int_],
) -> NDArray[np.bool_]:
    """Return (ngeom, ngeom): True where a contact of two geoms is one that no task means.

    A task means an object on a support, an object in the gripper, the parts of one object and the fingers on each
    other. Every other contact of arm or object is a touch; the rest of the cell is not looked at.
    """
    touch = np.zeros((model.ngeom, model.ngeom), dtype=bool)
    ours = np.union1d(arm, objects)
    touch[ours, :] = touch[:, ours] = True
    for first, second in ((objects, supports), (objects, gripper), (gripper, gripper)):
        touch[np.ix_(first, second)] = touch[np.ix_(second, first)] = False
    root = model.body_rootid[model.geom_bodyid]
    touch[np.ix_(objects, objects)] &= root[objects][:, None] != root[objects][None, :]
    return touch


def geom_name(model: mujoco.MjModel, geom: int) -> str:
    """Return a geom's name or, when it has none, its body's."""
    return model.geom(geom).name or f"body {model.body(model.geom_bodyid[geom]).name}"


def unmeant(data: mujoco.MjData, touch: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return (n, 2): the pairs of geoms in contacts that no task means."""
    contact = data.contact
    pairs: NDArray[np.int32] = contact.geom
    return np.asarray(pairs[touch[pairs[:, 0], pairs[:, 1]] & (contact.dist < 0.0)])
