"""The MuJoCo steps of one tick, in compiled code, and the judgement of each."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import Array
from rack.levels.compiled import compiled
from rack.levels.robot.cell import STATE, Cell
from rack.levels.robot.engine import contact_views, mj_get_state, mj_set_state, mj_step

TIME = int(mujoco.mjtState.mjSTATE_TIME)


class Substeps(NamedTuple):
    """Further arguments of `advance`, prepared once."""

    model: int  # address
    data: int  # address
    before: Array  # (state,): MuJoCo's state before the tick
    warnings: NDArray[np.int32]  # (kinds,), how often MuJoCo has raised each
    qpos: Array
    qvel: Array
    motors: Array  # (nv,), N m
    brakes: Array  # (nv,), N m
    joints: NDArray[np.int64]  # (2, joints): their addresses in qpos and in qvel
    bounds: Array  # (2, 3, joints): low and high of position, velocity, torque
    seen: Array  # (substeps, 3, joints): position, velocity, torque after each step
    contacts: NDArray[np.int32]  # (1,), their number
    geoms: NDArray[np.int32]  # (room, 2), of the contacts
    distance: Array  # (room,), m
    touch: NDArray[np.bool_]  # (ngeom, ngeom), True where a contact is unintended


def substeps(cell: Cell, data: mujoco.MjData, steps: int) -> Substeps:
    """Return the arguments of `advance` for `data` of a cell, `steps` steps a tick."""
    bounds = cell.bounds
    high = np.stack((bounds.position[:, 1], bounds.velocity, bounds.torque))
    low = np.stack((bounds.position[:, 0], -bounds.velocity, -bounds.torque))
    return Substeps(
        cell.model._address,
        data._address,
        np.zeros(mujoco.mj_stateSize(cell.model, STATE)),
        data.warning.number,
        data.qpos,
        data.qvel,
        data.qfrc_actuator,
        data.qfrc_applied,
        np.stack((cell.qpos, cell.dof)),
        np.stack((low, high)),
        np.zeros((steps, *low.shape)),
        *contact_views(cell.model, data),
        cell.touch,
    )


@compiled
def advance(  # flat arguments: a field of a named record takes 0.1 us
    begin: int,
    end_s: float,
    model: int,
    data: int,
    before: Array,
    warnings: NDArray[np.int32],
    qpos: Array,
    qvel: Array,
    motors: Array,
    brakes: Array,
    joints: NDArray[np.int64],
    bounds: Array,
    seen: Array,
    contacts: NDArray[np.int32],
    geoms: NDArray[np.int32],
    distance: Array,
    touch: NDArray[np.bool_],
) -> int:
    """Make the steps of a tick from number `begin` on, up to one that needs a closer look; the tick ends at `end_s`.

    Returns the number of the step to continue with; negative if the last one made broke a limit, or has an unintended
    contact, a warning, or a state that is not finite.
    """
    if begin == 0:
        mj_get_state(model, data, before.ctypes.data, STATE)
    for step in range(begin, len(seen)):
        mj_step(model, data)
        sound = True
        for joint in range(joints.shape[1]):
            dof = joints[1, joint]
            seen[step, 0, joint] = qpos[joints[0, joint]]
            seen[step, 1, joint] = qvel[dof]
            seen[step, 2, joint] = motors[dof] + brakes[dof]
            for kind in range(3):
                sound &= bounds[0, kind, joint] <= seen[step, kind, joint] <= bounds[1, kind, joint]
        for contact in range(contacts[0]):
            sound &= not (touch[geoms[contact, 0], geoms[contact, 1]] and distance[contact] < 0.0)
        for warned in warnings:
            sound &= warned == 0
        for value in qpos:
            sound &= math.isfinite(value)
        for value in qvel:
            sound &= math.isfinite(value)
        if not sound:
            return -(step + 1)
    time_s = np.full(1, end_s)  # exactly: what steps add up to differs in the last bit
    mj_set_state(model, data, time_s.ctypes.data, TIME)
    return len(seen)


@compiled
def copy_state(model: int, data: int, state: Array) -> None:
    """Fill `state` with MuJoCo's integration state."""
    mj_get_state(model, data, state.ctypes.data, STATE)


def preload() -> None:
    """Load this module's compiled functions."""
    model, none, table = mujoco.MjModel.from_xml_string("<mujoco/>"), np.zeros(0), np.zeros((0, 3, 0))
    data = mujoco.MjData(model)
    joints, touch = np.zeros((2, 0), dtype=int), np.zeros((0, 0), dtype=bool)
    state: list[Any] = [none, data.warning.number, none, none, none, none, joints, table, table]
    state += [*contact_views(model, data), touch]
    advance.load()(1, 0.0, model._address, data._address, *state)
    copy_state.load()(model._address, data._address, np.zeros(mujoco.mj_stateSize(model, STATE)))
