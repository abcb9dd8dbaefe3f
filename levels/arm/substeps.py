"""The MuJoCo steps of one tick, in compiled code, and the judgement of each."""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import Array, Mask
from rack.levels.compiled import compiled_for
from rack.levels.robot.cell import Cell
from rack.levels.robot.engine import (
    INTEGRATION,
    contact_views,
    mj_get_state,
    mj_set_state,
    mj_step,
    one_view,
    state_size,
)

TIME = int(mujoco.mjtState.mjSTATE_TIME)
PHYSICS = int(mujoco.mjtState.mjSTATE_PHYSICS)


class Substeps(NamedTuple):
    """Further arguments of `advance`, prepared once: few, because each array costs more than the
    arithmetic on it.
    """

    model: int  # address
    data: int  # address
    places: NDArray[np.int64]  # (4, joints), in `memory`: of position, velocity, motor, brake
    memory: Array  # MuJoCo's
    # (2 + substeps, 3, joints): lowest, highest and, after each step, position, velocity, torque
    judged: Array
    asleep: NDArray[np.int32]  # (trees,), see `copy_state`
    states: Array  # (2, state): before the tick; after it, as far as the steps change it
    warnings: NDArray[np.int32]  # (kinds,), how often MuJoCo has raised each
    contacts: NDArray[np.int32]  # (1,), their number
    geoms: NDArray[np.int32]  # (room, 2), of the contacts
    distance: Array  # (room,), m
    touch: Mask  # (ngeom, ngeom), True where a contact is unintended

    @property
    def seen(self) -> Array:
        """Position, velocity, torque after each step: (substeps, 3, joints)."""
        return self.judged[2:]


def substeps(cell: Cell, model: mujoco.MjModel, data: mujoco.MjData, steps: int) -> Substeps:
    """Return the arguments of `advance` for `data` of a cell, whose `model` makes `steps` steps a
    tick.
    """
    bounds = cell.bounds
    high = np.stack((bounds.position[:, 1], bounds.velocity, bounds.torque))
    low = np.stack((bounds.position[:, 0], -bounds.velocity, -bounds.torque))
    memory, (qpos, qvel, motors, brakes) = one_view(
        data.qpos, data.qvel, data.qfrc_actuator, data.qfrc_applied
    )
    return Substeps(
        model._address,
        data._address,
        np.stack((qpos + cell.qpos, qvel + cell.dof, motors + cell.dof, brakes + cell.dof)),
        memory,
        np.stack((low, high, *np.zeros((steps, *low.shape)))),
        data.tree_asleep,
        np.zeros((2, state_size(model))),
        data.warning.number,
        *contact_views(model, data),
        cell.geoms.touch,
    )


@compiled_for("i8, i8, i4[::1], f8[::1]")
def copy_state(model: int, data: int, asleep: NDArray[np.int32], state: Array) -> None:
    """Fill `state`, (state_size,), of which `asleep`, MuJoCo's `tree_asleep`, is the end."""
    mj_get_state(model, data, state.ctypes.data, INTEGRATION)
    first = len(state) - len(asleep)
    for tree in range(len(asleep)):
        state[first + tree] = asleep[tree]


@compiled_for(
    "i8, f8, i8, i8, i8[:,::1], f8[::1], f8[:,:,::1], i4[::1], f8[:,::1], i4[:], i4[::1], "
    "i4[:,:], f8[:], b1[:,::1]"
)
def advance(  # noqa: PLR0913  # flat arguments: a field of a record takes 0.1 us
    begin: int,
    end_s: float,
    model: int,
    data: int,
    places: NDArray[np.int64],
    memory: Array,
    judged: Array,
    asleep: NDArray[np.int32],
    states: Array,
    warnings: NDArray[np.int32],
    contacts: NDArray[np.int32],
    geoms: NDArray[np.int32],
    distance: Array,
    touch: Mask,
) -> int:
    """Make the steps of a tick from number `begin` on, up to one that needs a closer look; the tick
    ends at `end_s`.

    Returns the number of the step to continue with; negative if the last one made broke a limit, or
    has an unintended contact, a warning, or a state that is not finite.
    """
    before = states[0]
    after = states[1]
    low = judged[0]
    high = judged[1]
    seen = judged[2:]
    if begin == 0:
        copy_state(model, data, asleep, before)
    for step in range(begin, len(seen)):
        mj_step(model, data)
        sound = True
        for joint in range(places.shape[1]):
            seen[step, 0, joint] = memory[places[0, joint]]
            seen[step, 1, joint] = memory[places[1, joint]]
            seen[step, 2, joint] = memory[places[2, joint]] + memory[places[3, joint]]
            for kind in range(3):
                sound &= low[kind, joint] <= seen[step, kind, joint] <= high[kind, joint]
        for contact in range(contacts[0]):
            sound &= not (touch[geoms[contact, 0], geoms[contact, 1]] and distance[contact] < 0.0)
        for warned in warnings:
            sound &= warned == 0
        if step + 1 == len(seen):  # an earlier step's would be a warning of the next
            mj_get_state(model, data, after.ctypes.data, PHYSICS)
            for value in after:
                sound &= math.isfinite(value)
        if not sound:
            return -(step + 1)
    time_s = np.full(1, end_s)  # exactly: what steps add up to differs in the last bit
    mj_set_state(model, data, time_s.ctypes.data, TIME)
    return len(seen)
