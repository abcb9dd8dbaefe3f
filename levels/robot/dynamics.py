"""The arm's equation of motion for controllers: torque = M(q) qdd + bias(q, qd) + friction.

It is evaluated on separate data, with contacts and constraints off. It is therefore a pure function
of its arguments, independent of any simulation. (`qfrc_bias` of a simulation belongs to the state
before its last step.)
"""

from __future__ import annotations

import copy
import math
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import Array, apply_elementwise
from rack.levels.compiled import compiled_for
from rack.levels.robot.cell import Cell
from rack.levels.robot.engine import (
    add_offset,
    build_common_view,
    mj_com_pos,
    mj_flex,
    mj_fwd_velocity,
    mj_jac,
    mj_jac_dot,
    mj_kinematics,
    mj_make_m,
    mj_tendon,
    mj_transmission,
)

FRICTION_SPEED = 0.01
"""Joint speed, in rad/s, at which 3/4 of the dry friction is fed forward.

A step at zero speed would excite the arm.
"""

DISABLED_PARTS = (
    mujoco.mjtDisableBit.mjDSBL_CONTACT
    | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    | mujoco.mjtDisableBit.mjDSBL_SENSOR
)


class Payload(NamedTuple):
    """Mass in the gripper."""

    mass: float  # kg
    offset: Array  # (3,), m: centre of mass in the tool's frame


class Terms(NamedTuple):
    """Terms of the equation of motion at one state, without dry friction."""

    inertia: Array  # (joints, joints), kg m2
    # (joints,), N m: gravity, Coriolis and centrifugal torques, springs, viscous friction
    bias: Array


STATE_ROWS = 2
BIAS_ROW = 2
INERTIA_ROW = 3
"""Rows of an evaluation, (3 + joints, joints).

The first two are the state: position and velocity. The third is the bias, and the others are the
inertia.
"""


class Dynamics:
    """Evaluates the equation of motion of a cell's arm, with open fingers.

    If the state is the same as in the previous evaluation, the terms are not computed again.
    """

    def __init__(self, cell: Cell) -> None:
        self._model = copy.copy(cell.model)
        self._model.opt.disableflags |= int(DISABLED_PARTS)
        self._data = d = mujoco.MjData(self._model)
        mujoco.mj_resetDataKeyframe(self._model, d, 0)
        joints = len(cell.dof)
        # Compiled functions take one array instead of eight, because passing an array costs more
        # than the arithmetic on it.
        evaluations = np.zeros((2, INERTIA_ROW + joints, joints))
        # The first evaluation is without payload, for users to read. The second includes it.
        self.newest, current = evaluations
        self.newest[:STATE_ROWS] = np.nan  # not evaluated yet
        self._terms = Terms(current[INERTIA_ROW:], current[BIAS_ROW])
        self._position, self._velocity = current[:STATE_ROWS]
        self._offset = np.zeros(3)
        at = self._model._address, d._address
        self._evaluating = *at, *find_memory_indices(self._model, d, cell), evaluations
        hand = int(cell.model.site_bodyid[cell.tool])
        tool = (d.site_xpos[cell.tool], d.site_xmat[cell.tool])
        gravity = np.array(self._model.opt.gravity)
        jacobians = np.zeros((2, 3, cell.model.nv))
        self._carrying = self._offset, *at, cell.dof, hand, *tool, gravity, jacobians, current
        self._evaluate = evaluate_terms.load_machine_code()
        self._carry = add_payload.load_machine_code()
        self.dry = np.array(cell.model.dof_frictionloss[cell.dof])  # (joints,), N m: dry friction

    def terms(self, q: Array, qd: Array, payload: Payload | None = None) -> Terms:
        """Return inertia and bias at a state. The arrays are valid until the next call.

        Args:
            q: Positions, (joints,), rad.
            qd: Velocities, (joints,), rad/s.
            payload: Mass in the gripper. None if it is empty.
        """
        self._position[:] = q
        self._velocity[:] = qd
        self._evaluate(*self._evaluating)
        if payload is not None and payload.mass > 0.0:
            self._offset[:] = payload.offset
            self._carry(float(payload.mass), *self._carrying)
        return self._terms

    @property
    def evaluated(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """MuJoCo's model and data, in the state of the last evaluation."""
        return self._model, self._data

    def friction(self, velocity: Array) -> Array:
        """Return the torque of dry friction in N m at `velocity` in rad/s, both (joints,)."""
        return np.asarray(self.dry * apply_elementwise(math.tanh, velocity / FRICTION_SPEED))


def find_memory_indices(
    model: mujoco.MjModel, data: mujoco.MjData, cell: Cell
) -> tuple[NDArray[np.int64], Array]:
    """Return the indices of the elements of MuJoCo's memory that an evaluation uses.

    Returns:
        Indices, (4 + joints, joints), and a view of the memory of `data` to which they refer. The
        rows are for position, velocity, bias, passive force, and each row of the inertia. An
        element of the inertia that is always zero has the index -1.
    """
    memory, (qpos, qvel, bias, passive, inertia) = build_common_view(
        data.qpos, data.qvel, data.qfrc_bias, data.qfrc_passive, data.M
    )
    # MuJoCo stores the nonzero elements of the lower triangle, row by row.
    lower = np.full((model.nv, model.nv), -1)
    for row, (first, count) in enumerate(zip(model.M_rowadr, model.M_rownnz, strict=True)):
        entries = np.arange(first, first + count)
        lower[row, model.M_colind[entries]] = inertia + entries
    symmetric = np.maximum(lower, lower.T)[np.ix_(cell.dof, cell.dof)]
    return (
        np.vstack(
            (qpos + cell.qpos, qvel + cell.dof, bias + cell.dof, passive + cell.dof, symmetric)
        ),
        memory,
    )


@compiled_for("i8, i8, i8[:,::1], f8[::1], f8[:,:,::1]")
def evaluate_terms(
    model: int, data: int, places: NDArray[np.int64], memory: Array, evaluations: Array
) -> None:
    """Evaluate the equation of motion, unless it has been evaluated at the same state.

    Args:
        model: Address of the model.
        data: Address of the data.
        places: Indices in `memory`, see `find_memory_indices`.
        memory: Memory of the data.
        evaluations: (2, 3 + joints, joints). The first is the last evaluation, and the second has
            the state at which to evaluate. Afterwards both contain the new evaluation.
    """
    newest, current = evaluations
    joints = places.shape[1]
    same = True
    for row in range(STATE_ROWS):
        for joint in range(joints):
            same &= newest[row, joint] == current[row, joint]
            newest[row, joint] = memory[places[row, joint]] = current[row, joint]
    if not same:
        # These six are all steps of `mj_fwdPosition` that inertia and bias need.
        mj_kinematics(model, data)
        mj_com_pos(model, data)
        mj_flex(model, data)
        mj_tendon(model, data)
        mj_make_m(model, data)
        mj_transmission(model, data)
        mj_fwd_velocity(model, data)
        for joint in range(joints):
            newest[BIAS_ROW, joint] = memory[places[2, joint]] - memory[places[3, joint]]
            for other in range(joints):
                place = places[4 + joint, other]
                newest[INERTIA_ROW + joint, other] = memory[place] if place >= 0 else 0.0
    current[BIAS_ROW:] = newest[BIAS_ROW:]


@compiled_for("f8, f8[::1], i8, i8, i8[::1], i8, f8[::1], f8[::1], f8[::1], f8[:,:,::1], f8[:,::1]")
def add_payload(  # noqa: PLR0913  # flat, as `make_steps` in levels/arm/substeps.py
    mass: float,
    offset: Array,
    model: int,
    data: int,
    dof: NDArray[np.int64],
    hand: int,
    tool: Array,
    turned: Array,
    gravity: Array,
    jacobians: Array,
    evaluation: Array,
) -> None:
    """Add a point mass at the tool: m J^T J to the inertia, m J^T (Jdot qd - g) to the bias.

    Args:
        mass: Mass, kg.
        offset: Centre of the mass in the tool's frame, (3,), m.
        model: Address of the model.
        data: Address of the data.
        dof: Addresses of the joints in qvel.
        hand: Body of the tool.
        tool: Position of the tool, (3,), m.
        turned: Rotation matrix of the tool, (9,).
        gravity: Gravity, (3,), m/s2.
        jacobians: Work space, (2, 3, nv).
        evaluation: The evaluation to change, (3 + joints, joints).
    """
    velocity = evaluation[1]
    bias = evaluation[BIAS_ROW]
    inertia = evaluation[INERTIA_ROW:]
    centre = np.empty(3)
    add_offset(tool, turned, offset, centre)
    mj_jac(model, data, jacobians[0].ctypes.data, 0, centre.ctypes.data, hand)
    mj_jac_dot(model, data, jacobians[1].ctypes.data, 0, centre.ctypes.data, hand)
    count = len(dof)
    for axis in range(3):
        jacobian = jacobians[0, axis]
        change = jacobians[1, axis]
        acceleration = -gravity[axis]
        for joint in range(count):
            acceleration += change[dof[joint]] * velocity[joint]
        for joint in range(count):
            force = mass * jacobian[dof[joint]]
            bias[joint] += force * acceleration
            for other in range(count):
                inertia[joint, other] += force * jacobian[dof[other]]
