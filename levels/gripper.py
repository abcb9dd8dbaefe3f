"""The fingers of a gripper: one joint is driven, the others are geared to it by the model's joint equalities."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray


def set_opening(model: mujoco.MjModel, qpos: NDArray[np.float64], address: int, opening: float) -> None:
    """Set the gripper's joint at `address` of `qpos` to `opening`, m or rad, and the fingers geared to it."""
    qpos[address] = opening
    for k in np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_obj2id >= 0)):
        first, second = model.jnt_qposadr[model.eq_obj1id[k]], model.jnt_qposadr[model.eq_obj2id[k]]
        # The first joint follows a polynomial of the second; both count from their reference positions.
        turn = opening - model.qpos0[address]
        if second == address:
            qpos[first] = model.qpos0[first] + np.polynomial.polynomial.polyval(turn, model.eq_data[k, :5])
        elif first == address and model.eq_data[k, 1]:
            qpos[second] = model.qpos0[second] + (turn - model.eq_data[k, 0]) / model.eq_data[k, 1]
