"""The arm's equation of motion, as a controller knows it: torque = M(q) qdd + bias(q, qd) + friction.

Evaluated on separate data, with contacts and constraints off: a pure function of its arguments, not of a simulation.
(`qfrc_bias` of a simulation belongs to the state before its last step.)
"""

from __future__ import annotations

import copy
import math
from typing import NamedTuple

import mujoco
import numpy as np

from rack.levels.algebra import Array, each, gram, mat_vec, transposed_mat_vec
from rack.levels.robot.cell import Cell

FRICTION_SPEED = 0.01
"""Joint speed, rad/s, at which 3/4 of the dry friction is fed forward: a step at zero speed would excite the arm."""

OFF = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_SENSOR


class Payload(NamedTuple):
    """A mass in the gripper."""

    mass: float  # kg
    offset: Array  # (3,), m: its centre in the tool's frame


class Terms(NamedTuple):
    """The equation at one state; dry friction is separate."""

    inertia: Array  # (joints, joints), kg m2
    bias: Array  # (joints,), N m: gravity, Coriolis and centrifugal torques, springs, viscous friction


class Dynamics:
    """Evaluates the equation of motion of a cell's arm, its fingers open."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._model = copy.copy(cell.model)
        self._model.opt.disableflags |= int(OFF)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_resetDataKeyframe(self._model, self._data, 0)
        self._hand = int(cell.model.site_bodyid[cell.tool])
        joints, nv = len(cell.dof), cell.model.nv
        self._full = np.zeros((nv, nv))
        self._block = cell.dof[:, None] * nv + cell.dof[None, :]
        self._terms = Terms(np.zeros((joints, joints)), np.zeros(joints))
        self._jacobian, self._jacobian_dot = np.zeros((3, nv)), np.zeros((3, nv))
        self._dry = np.array(cell.model.dof_frictionloss[cell.dof])

    def terms(self, q: Array, qd: Array, payload: Payload | None = None) -> Terms:
        """Return the terms at `q`, rad, and `qd`, rad/s, (joints,) each. The arrays are valid until the next call."""
        m, d, (inertia, bias) = self._model, self._data, self._terms
        d.qpos[self._cell.qpos] = q
        d.qvel[self._cell.dof] = qd
        mujoco.mj_fwdPosition(m, d)
        mujoco.mj_fwdVelocity(m, d)
        mujoco.mj_fullM(m, d, self._full)
        np.take(self._full, self._block, out=inertia)
        np.subtract(d.qfrc_bias, d.qfrc_passive, out=self._full[0])
        np.take(self._full[0], self._cell.dof, out=bias)
        if payload is not None and payload.mass > 0.0:
            self._carry(payload, qd)
        return self._terms

    def friction(self, velocity: Array) -> Array:
        """Return dry friction, N m, that opposes motion at `velocity`, rad/s, (joints,)."""
        return np.asarray(self._dry * each(math.tanh, velocity / FRICTION_SPEED))

    def pose(self, q: Array) -> tuple[Array, Array]:
        """Return position (3,), m, and rotation (3, 3) of the tool at `q`. The arrays are valid until the next call."""
        m, d = self._model, self._data
        d.qpos[self._cell.qpos] = q
        mujoco.mj_kinematics(m, d)
        return d.site_xpos[self._cell.tool], d.site_xmat[self._cell.tool].reshape(3, 3)

    def _carry(self, payload: Payload, qd: Array) -> None:
        """Add a point mass at the tool: m J^T J to the inertia, m J^T (Jdot qd - g) to the bias."""
        m, d, (inertia, bias) = self._model, self._data, self._terms
        tool, dof = self._cell.tool, self._cell.dof
        centre = d.site_xpos[tool] + mat_vec(d.site_xmat[tool].reshape(3, 3), payload.offset)
        mujoco.mj_jac(m, d, self._jacobian, None, centre, self._hand)
        mujoco.mj_jacDot(m, d, self._jacobian_dot, None, centre, self._hand)
        jacobian = np.take(self._jacobian, dof, axis=1)
        acceleration = mat_vec(np.take(self._jacobian_dot, dof, axis=1), qd) - m.opt.gravity
        inertia += payload.mass * gram(jacobian)
        bias += payload.mass * transposed_mat_vec(jacobian, acceleration)
