"""The state of a cell's simulation: everything that its next step depends on.

MuJoCo's integration state does not say which bodies sleep, so that follows it. What lies at rest
sleeps until something awake touches it: in `nasrem` its blocks take two thirds of the time of a
step while they are awake. A simulation restored from this state continues bit for bit, asleep or
awake.
"""

from __future__ import annotations

from copy import copy

import mujoco
import numpy as np

from rack.levels.algebra import Array, norm
from rack.levels.robot.engine import INTEGRATION, mj_update_sleep
from rack.levels.tables import SceneConfig

SLEEP = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
STEPS_AT_REST = 10
"""Steps in which a body is slower than `sleep_tolerance` before it sleeps: MuJoCo's mjMINAWAKE."""


def state_size(model: mujoco.MjModel) -> int:
    """Return the length of a state."""
    return int(mujoco.mj_stateSize(model, INTEGRATION)) + int(model.ntree)


def save_state(model: mujoco.MjModel, data: mujoco.MjData, state: Array) -> None:
    """Fill `state`, (state_size,)."""
    trees = state.size - model.ntree
    mujoco.mj_getState(model, data, state[:trees], INTEGRATION)
    state[trees:] = data.tree_asleep


def view_state(model: mujoco.MjModel, data: mujoco.MjData, state: Array) -> None:
    """Set `data`, of which nothing sleeps, to a state but for sleep: enough to look at it."""
    end = mujoco.mj_stateSize(model, INTEGRATION)
    mujoco.mj_setState(model, data, np.ascontiguousarray(state[:end]), INTEGRATION)


def restore_state(model: mujoco.MjModel, data: mujoco.MjData, state: Array) -> None:
    """Set `data` to a state, so that its next steps are those of the data that was saved."""
    data.tree_asleep[:] = -1
    mj_update_sleep(model._address, data._address)
    view_state(model, data, state)
    asleep = state[state.size - model.ntree :]
    if (asleep >= 0).any():
        # Steps no longer compute what belongs to sleeping bodies: here, once, while they are awake.
        mujoco.mj_forward(model, data)
        view_state(model, data, state)
    data.tree_asleep[:] = asleep
    mj_update_sleep(model._address, data._address)


def sleeping(model: mujoco.MjModel, scene: SceneConfig) -> mujoco.MjModel:
    """Return the model to step a simulation with: bodies at rest sleep where all that could move
    them wakes them.

    A mocap body that moves does not, and MuJoCo ends the process at tendon equalities and flexible
    bodies that might sleep. Where steps are short, or gravity weak, a body would sleep in the air,
    at the turning point of its flight. Only for whole steps: parts of one, called by themselves,
    leave out what does not move.
    """
    found = copy(model)
    option = found.opt
    gained = STEPS_AT_REST * option.timestep * norm(option.gravity)  # m/s, in falling
    tendons = model.eq_type == mujoco.mjtEq.mjEQ_TENDON
    lingers = gained < 4.0 * option.sleep_tolerance  # in the air, for longer than those steps
    if not (lingers or scene.motion or tendons.any() or model.nflex):
        option.enableflags |= SLEEP
    return found
