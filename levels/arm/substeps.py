"""The MuJoCo steps of one tick, each checked against limits, in compiled code."""

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
    build_common_view,
    build_contact_views,
    compute_state_size,
    mj_get_state,
    mj_set_state,
    mj_step,
)

TIME = int(mujoco.mjtState.mjSTATE_TIME)
PHYSICS = int(mujoco.mjtState.mjSTATE_PHYSICS)


class Substeps(NamedTuple):
    """Constant arguments of `make_steps`, prepared once.

    There are few arrays, because passing an array takes longer than the arithmetic on it.
    """

    model: int  # address
    data: int  # address
    places: NDArray[np.int64]  # (4, joints), index in `memory`: position, velocity, motor, brake
    memory: Array  # memory of MuJoCo's data
    # (2 + substeps, 3, joints): position, velocity and torque of each joint. First the lowest and
    # the highest permitted values, then the values after each step.
    judged: Array
    asleep: NDArray[np.int32]  # (trees,), see `copy_state`
    states: Array  # (2, state): state before the tick; the part that steps change, after it
    warnings: NDArray[np.int32]  # (kinds,), count of MuJoCo's warnings
    contacts: NDArray[np.int32]  # (1,), number of contacts
    geoms: NDArray[np.int32]  # (capacity, 2), pairs of geoms in contact
    distance: Array  # (capacity,), m
    touch: Mask  # (ngeom, ngeom), True where a contact is unintended

    @property
    def seen(self) -> Array:
        """Position, velocity and torque after each step, (substeps, 3, joints)."""
        return self.judged[2:]


def prepare_substeps(
    cell: Cell, model: mujoco.MjModel, data: mujoco.MjData, steps: int
) -> Substeps:
    """Prepare the arguments of `make_steps`.

    Args:
        cell: The cell.
        model: The model that makes the steps.
        data: The data of the simulation.
        steps: Number of steps in a tick.
    """
    bounds = cell.bounds
    high = np.stack((bounds.position[:, 1], bounds.velocity, bounds.torque))
    low = np.stack((bounds.position[:, 0], -bounds.velocity, -bounds.torque))
    memory, (qpos, qvel, motors, brakes) = build_common_view(
        data.qpos, data.qvel, data.qfrc_actuator, data.qfrc_applied
    )
    return Substeps(
        model._address,
        data._address,
        np.stack((qpos + cell.qpos, qvel + cell.dof, motors + cell.dof, brakes + cell.dof)),
        memory,
        np.stack((low, high, *np.zeros((steps, *low.shape)))),
        data.tree_asleep,
        np.zeros((2, compute_state_size(model))),
        data.warning.number,
        *build_contact_views(model, data),
        cell.geoms.touch,
    )


@compiled_for("i8, i8, i4[::1], f8[::1]")
def copy_state(model: int, data: int, asleep: NDArray[np.int32], state: Array) -> None:
    """Copy the state of the simulation to `state`.

    Args:
        model: Address of the model.
        data: Address of the data.
        asleep: MuJoCo's `tree_asleep`, (trees,), which is stored at the end of the state.
        state: Receives the state, (state_size,).
    """
    mj_get_state(model, data, state.ctypes.data, INTEGRATION)
    first = len(state) - len(asleep)
    for tree in range(len(asleep)):
        state[first + tree] = asleep[tree]


@compiled_for(
    "i8, f8, i8, i8, i8[:,::1], f8[::1], f8[:,:,::1], i4[::1], f8[:,::1], i4[:], i4[::1], "
    "i4[:,:], f8[:], b1[:,::1]"
)
def make_steps(  # noqa: PLR0913  # flat arguments: a field of a record takes 0.1 us
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
    """Simulate the steps of a tick, until all are made or one fails a check.

    A step fails if it violates a limit, has an unintended contact or a MuJoCo warning, or ends in a
    state that is not finite. For the arguments from `model` on see `Substeps`.

    Args:
        begin: Number of the first step to make.
        end_s: Simulated time at the end of the tick, s.
        model: Address of the model.
        data: Address of the data.
        places: See `Substeps`.
        memory: See `Substeps`.
        judged: See `Substeps`.
        asleep: See `Substeps`.
        states: See `Substeps`.
        warnings: See `Substeps`.
        contacts: See `Substeps`.
        geoms: See `Substeps`.
        distance: See `Substeps`.
        touch: See `Substeps`.

    Returns:
        The number of steps made in this tick, as a negative number if the last one failed a check.
    """
    before = states[0]
    after = states[1]
    low, high = judged[:2]
    seen = judged[2:]
    if begin == 0:
        copy_state(model, data, asleep, before)
    for step in range(begin, len(seen)):
        mj_step(model, data)
        is_valid = True
        for joint in range(places.shape[1]):
            seen[step, 0, joint] = memory[places[0, joint]]
            seen[step, 1, joint] = memory[places[1, joint]]
            seen[step, 2, joint] = memory[places[2, joint]] + memory[places[3, joint]]
            for kind in range(3):
                is_valid &= low[kind, joint] <= seen[step, kind, joint] <= high[kind, joint]
        for contact in range(contacts[0]):
            is_valid &= not (
                touch[geoms[contact, 0], geoms[contact, 1]] and distance[contact] < 0.0
            )
        for warned in warnings:
            is_valid &= warned == 0
        # Only the last step is checked, because MuJoCo warns in a step whose initial state is not
        # finite.
        if step + 1 == len(seen):
            mj_get_state(model, data, after.ctypes.data, PHYSICS)
            for value in after:
                is_valid &= math.isfinite(value)
        if not is_valid:
            return -(step + 1)
    # The sum of the steps may differ from `end_s` in the last bit.
    time_s = np.full(1, end_s)
    mj_set_state(model, data, time_s.ctypes.data, TIME)
    return len(seen)
