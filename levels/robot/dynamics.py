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
from numpy.typing import NDArray

from rack.levels.algebra import Array, each
from rack.levels.compiled import compiled
from rack.levels.robot.cell import Cell
from rack.levels.robot.engine import mj_full_m, mj_fwd_position, mj_fwd_velocity, mj_jac, mj_jac_dot

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


class Evaluated(NamedTuple):
    """The newest evaluation of a `Dynamics`, not to be written to. The arrays stay the same ones."""

    state: Array  # (2, joints), rad and rad/s; NaN: there is none
    inertia: Array  # (joints, joints), kg m2
    bias: Array  # (joints,), N m


class Dynamics:
    """Evaluates the equation of motion of a cell's arm, its fingers open; the same state again costs nothing."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._model = copy.copy(cell.model)
        self._model.opt.disableflags |= int(OFF)
        self._data = d = mujoco.MjData(self._model)
        mujoco.mj_resetDataKeyframe(self._model, d, 0)
        joints, nv = len(cell.dof), cell.model.nv
        self._wanted = np.zeros((2, joints))
        self.newest = Evaluated(np.full((2, joints), np.nan), np.zeros((joints, joints)), np.zeros(joints))
        self._terms = Terms(np.zeros((joints, joints)), np.zeros(joints))  # a copy, with the payload
        self._offset = np.zeros(3)
        # Arguments of the compiled functions.
        at, full = (self._model._address, d._address, np.stack((cell.qpos, cell.dof))), np.zeros((nv, nv))
        self._evaluating = *at, d.qpos, d.qvel, d.qfrc_bias, d.qfrc_passive, full, *self.newest, *self._terms
        hand, tool = int(cell.model.site_bodyid[cell.tool]), (d.site_xpos[cell.tool], d.site_xmat[cell.tool])
        gravity, jacobians = np.array(self._model.opt.gravity), np.zeros((2, 3, nv))
        self._carrying = self._offset, *at, hand, *tool, gravity, jacobians, self.newest.state, *self._terms
        self._evaluate, self._carry = evaluate.load(), carry.load()
        self.dry = np.array(cell.model.dof_frictionloss[cell.dof])  # (joints,), N m: dry friction

    def terms(self, q: Array, qd: Array, payload: Payload | None = None) -> Terms:
        """Return the terms at `q`, rad, and `qd`, rad/s, (joints,) each. The arrays are valid until the next call."""
        self._wanted[0], self._wanted[1] = q, qd
        self._evaluate(self._wanted, *self._evaluating)
        if payload is not None and payload.mass > 0.0:
            self._offset[:] = payload.offset
            self._carry(float(payload.mass), *self._carrying)
        return self._terms

    def friction(self, velocity: Array) -> Array:
        """Return dry friction, N m, that opposes motion at `velocity`, rad/s, (joints,)."""
        return np.asarray(self.dry * each(math.tanh, velocity / FRICTION_SPEED))

    def pose(self, q: Array) -> tuple[Array, Array]:
        """Return position (3,), m, and rotation (3, 3) of the tool at `q`. The arrays are valid until the next call."""
        m, d = self._model, self._data
        self.newest.state[:] = np.nan
        d.qpos[self._cell.qpos] = q
        mujoco.mj_kinematics(m, d)
        return d.site_xpos[self._cell.tool], d.site_xmat[self._cell.tool].reshape(3, 3)


@compiled
def evaluate(
    wanted: Array,
    model: int,
    data: int,
    joints: NDArray[np.int64],
    qpos: Array,
    qvel: Array,
    forces: Array,
    passive: Array,
    full: Array,
    state: Array,
    inertia: Array,
    bias: Array,
    inertia_copy: Array,
    bias_copy: Array,
) -> None:
    """Evaluate `inertia` and `bias` at the state `wanted`, (2, joints), unless that is `state` already; copy them.

    `joints` are addresses in `qpos` and `qvel`.
    """
    count, same = joints.shape[1], True
    for joint in range(count):
        same &= state[0, joint] == wanted[0, joint] and state[1, joint] == wanted[1, joint]
        state[0, joint] = qpos[joints[0, joint]] = wanted[0, joint]
        state[1, joint] = qvel[joints[1, joint]] = wanted[1, joint]
    if not same:
        mj_fwd_position(model, data)
        mj_fwd_velocity(model, data)
        mj_full_m(model, data, full.ctypes.data)
    for joint in range(count):
        row = joints[1, joint]
        bias[joint] = bias_copy[joint] = forces[row] - passive[row]
        for other in range(count):
            inertia[joint, other] = inertia_copy[joint, other] = full[row, joints[1, other]]


@compiled
def carry(
    mass: float,
    offset: Array,
    model: int,
    data: int,
    joints: NDArray[np.int64],
    hand: int,
    tool: Array,
    turned: Array,
    gravity: Array,
    jacobians: Array,
    state: Array,
    inertia: Array,
    bias: Array,
) -> None:
    """Add a point mass at the tool: m J^T J to the inertia, m J^T (Jdot qd - g) to the bias."""
    centre = np.empty(3)
    for axis in range(3):
        of = turned[3 * axis : 3 * axis + 3]
        centre[axis] = tool[axis] + (of[0] * offset[0] + of[1] * offset[1] + of[2] * offset[2])
    mj_jac(model, data, jacobians[0].ctypes.data, 0, centre.ctypes.data, hand)
    mj_jac_dot(model, data, jacobians[1].ctypes.data, 0, centre.ctypes.data, hand)
    count = joints.shape[1]
    for axis in range(3):
        jacobian, change = jacobians[0, axis], jacobians[1, axis]
        acceleration = -gravity[axis]
        for joint in range(count):
            acceleration += change[joints[1, joint]] * state[1, joint]
        for joint in range(count):
            force = mass * jacobian[joints[1, joint]]
            bias[joint] += force * acceleration
            for other in range(count):
                inertia[joint, other] += force * jacobian[joints[1, other]]


def preload() -> None:
    """Load this module's compiled functions."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    data, joints, none, square = mujoco.MjData(model), np.zeros((2, 0), dtype=int), np.zeros(0), np.zeros((0, 0))
    at, state, place = (model._address, data._address, joints), np.zeros((2, 0)), np.zeros(3)
    evaluate.load()(state, *at, none, none, none, none, square, state, square, none, square, none)
    jacobians = np.zeros((2, 3, 0))
    carry.load()(0.0, place, *at, 0, place, np.zeros(9), place, jacobians, state, square, none)
