"""The state of a cell's simulation: everything that its next step depends on.

MuJoCo's integration state does not say which bodies sleep, so that follows it. What lies at rest
sleeps until something awake touches it: in `nasrem` its blocks take two thirds of the time of a
step while they are awake. A simulation restored from this state continues bit for bit, asleep or
awake.
"""

from __future__ import annotations

import mujoco
import numpy as np

from rack.levels.algebra import Array
from rack.levels.robot.engine import INTEGRATION

SLEEP = int(mujoco.mjtEnableBit.mjENBL_SLEEP)


def state_size(model: mujoco.MjModel) -> int:
    """Return the length of a state."""
    return int(mujoco.mj_stateSize(model, INTEGRATION)) + int(model.ntree)


def view_state(model: mujoco.MjModel, data: mujoco.MjData, state: Array) -> None:
    """Set `data`, of which nothing sleeps, to a state but for sleep: enough to look at it."""
    end = mujoco.mj_stateSize(model, INTEGRATION)
    mujoco.mj_setState(model, data, np.ascontiguousarray(state[:end]), INTEGRATION)
