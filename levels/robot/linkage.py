"""The linkage of a gripper: one joint is driven, the others that the arm carries follow it by the
model's equalities.

MuJoCo writes every equality (a gear, a loop closed by `connect` or `weld`, a coupled tendon), and
every joint stop that is exceeded, as rows of residual and Jacobian. Gauss-Newton over them, with
the joints' springs as weak rows, finds where the linkage settles. It is solved once for a number of
openings; a pose in between is interpolated, which costs a cycle some microseconds. MuJoCo's own
kernels add up in a fixed order: equal models give equal poses.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import Array
from rack.levels.errors import RobotError

OPENINGS = 33
"""Openings at which the linkage is solved, evenly from one end to the other."""
APPROACH_STEPS = 8
"""Steps from the model's reference pose to the nearest opening: a loop must not flip over on the
way."""
ITERATIONS = 60
STEP_TOLERANCE = 1e-10
SPRING_PART = 1e-6
"""Weight of the stiffest spring against an equality."""
DAMPING = 1e-9
"""Weight of staying in place, for joints that nothing determines."""
FREE_PART = 0.01
"""Share of `DAMPING` in all that holds a joint, above which the joint counts as free."""
RESIDUAL = 1e-3
"""An equality that stays open by more than this, in m or rad, is not solved."""
NOT_POSED = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
SCALAR_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


@dataclass(frozen=True)
class Linkage:
    """Positions of a gripper's joints, by its opening."""

    driven: int  # address of the driven joint in qpos
    openings: Array  # (k,), rising, m or rad
    joints: NDArray[np.int_]  # (n,), addresses in qpos of the joints that follow
    positions: Array  # (n, k), m or rad

    def set(self, qpos: Array, opening: float) -> None:
        """Set the driven joint in `qpos` to `opening`, m or rad, and all that follow it."""
        qpos[self.driven] = opening
        for address, positions in zip(self.joints, self.positions, strict=True):
            qpos[address] = np.interp(opening, self.openings, positions)


def solve_linkage(
    model: mujoco.MjModel, joint: int, hand: NDArray[np.bool_], ends: tuple[float, float]
) -> Linkage:
    """Return the linkage driven by `joint` in the bodies `hand` (nbody,), between the openings
    `ends`.

    Joints with their own motor do not follow. Raises `RobotError` with the equality that cannot be
    kept, or the joint that nothing determines.
    """
    solver = _Solver(model, joint, hand)
    openings = np.linspace(min(ends), max(ends), OPENINGS)
    rest = float(model.qpos0[solver.driven])
    first = int(np.argmin(np.abs(openings - rest)))
    positions = np.zeros((len(solver.joints), OPENINGS))
    for opening in np.linspace(rest, openings[first], APPROACH_STEPS):
        middle = solver.settle(model.qpos0, float(opening))
    for way in (range(first, OPENINGS), range(first, -1, -1)):
        qpos = middle
        for k in way:
            qpos = solver.settle(qpos, float(openings[k]))
            solver.check(float(openings[k]))
            positions[:, k] = qpos[solver.joints]
    solver.check_all_follow()
    follows = np.any(positions != model.qpos0[solver.joints][:, None], axis=1)
    return Linkage(solver.driven, openings, solver.joints[follows], positions[follows])


class _Solver:
    """Finds the joints of one linkage at one opening."""

    def __init__(self, model: mujoco.MjModel, joint: int, hand: NDArray[np.bool_]) -> None:
        self._model = copy.copy(model)
        self._model.opt.disableflags |= int(NOT_POSED)
        self._data = mujoco.MjData(self._model)
        motors = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0]
        carried = hand[model.jnt_bodyid]
        # The body that carries the linkage may be moved by a joint of the arm itself: that has a
        # motor.
        carried[motors] = carried[joint] = False
        self._others = np.flatnonzero(carried & ~np.isin(model.jnt_type, SCALAR_JOINTS))
        follow = np.flatnonzero(carried & np.isin(model.jnt_type, SCALAR_JOINTS))
        self._follow = follow
        self._loose = np.ones(len(follow), dtype=bool)
        self.driven = int(model.jnt_qposadr[joint])
        self.joints = model.jnt_qposadr[follow].astype(int)
        self._dof = model.jnt_dofadr[follow]
        self._driven_dof = int(model.jnt_dofadr[joint])
        stiffness = model.jnt_stiffness[follow]
        self._springs = SPRING_PART * stiffness / max(float(np.max(stiffness, initial=0.0)), 1e-12)
        self._relaxed = model.qpos_spring[self.joints]
        self._weights = np.diag(self._springs + DAMPING)

    def settle(self, start: Array, opening: float) -> Array:
        """Return qpos with the linkage settled at `opening`, searched from `start`."""
        data = self._data
        count = len(self.joints)
        data.qpos[:] = start
        data.qpos[self.driven] = opening
        matrix = np.zeros((count, count))
        slope = np.zeros(count)
        step = np.zeros(count)
        for _ in range(ITERATIONS if count else 0):
            residual, jacobian = self._rows()
            mujoco.mju_mulMatTMat(matrix, jacobian, jacobian)
            mujoco.mju_mulMatTVec(slope, jacobian, residual)
            matrix += self._weights
            slope += self._springs * (data.qpos[self.joints] - self._relaxed)
            mujoco.mju_cholFactor(matrix, 0.0)
            mujoco.mju_cholSolve(step, matrix, slope)
            data.qpos[self.joints] -= step
            if float(np.max(np.abs(step))) < STEP_TOLERANCE:
                break
        for k in np.flatnonzero(self._loose):
            # If a joint is free to move, only staying in place resists.
            mujoco.mju_cholSolve(step, matrix, DAMPING * np.eye(count)[k])
            self._loose[k] = step[k] > FREE_PART
        return np.array(data.qpos)

    def check(self, opening: float) -> None:
        """Raise `RobotError` where the last pose leaves an equality open."""
        data = self._data
        jacobian = self._jacobian()
        ours = np.any(jacobian[:, [*self._dof, self._driven_dof]] != 0.0, axis=1)
        ours &= data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        if not ours.any():
            return
        worst = int(np.argmax(np.where(ours, np.abs(data.efc_pos), 0.0)))
        away = abs(float(data.efc_pos[worst]))
        if away > RESIDUAL:
            name = _equality_name(self._model, int(data.efc_id[worst]))
            raise RobotError(
                f"robot.gripper: equality {name} is {away:.4f} m or rad off with the gripper at"
                f" {opening:g}; at most {RESIDUAL:g} can be planned with"
            )

    def check_all_follow(self) -> None:
        """Raise `RobotError` for a joint that neither an equality nor a spring determines."""
        for joint in (*self._others, *self._follow[self._loose]):
            name = (
                self._model.joint(int(joint)).name
                or f"of body {self._model.body(self._model.jnt_bodyid[joint]).name}"
            )
            raise RobotError(
                f"robot.gripper: joint '{name}' follows nothing; give it an equality with the"
                " driven joint, or a spring"
            )

    def _rows(self) -> tuple[Array, Array]:
        """Return residuals (rows,) and their Jacobian (rows, joints): equalities, and joint stops
        that are exceeded."""
        data = self._data
        jacobian = self._jacobian()[:, self._dof]
        counts = (data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY) | (data.efc_pos < 0.0)
        rows = np.flatnonzero(counts & np.any(jacobian != 0.0, axis=1))
        return np.array(data.efc_pos[rows]), np.ascontiguousarray(jacobian[rows])

    def _jacobian(self) -> Array:
        """Return the Jacobian (rows, nv) of all constraints at the present pose."""
        mujoco.mj_fwdPosition(self._model, self._data)
        return np.asarray(self._data.efc_J).reshape(-1, self._model.nv)


def _equality_name(model: mujoco.MjModel, equality: int) -> str:
    """Return an equality's name or, when it has none, its kind and what it couples."""
    if name := model.equality(equality).name:
        return f"'{name}'"
    kind = mujoco.mjtEq(int(model.eq_type[equality]))
    objects = {
        mujoco.mjtEq.mjEQ_JOINT: mujoco.mjtObj.mjOBJ_JOINT,
        mujoco.mjtEq.mjEQ_TENDON: mujoco.mjtObj.mjOBJ_TENDON,
    }
    of = objects.get(kind, mujoco.mjtObj(int(model.eq_objtype[equality])))
    ids = [int(k[equality]) for k in (model.eq_obj1id, model.eq_obj2id)]
    ends = [f"'{mujoco.mj_id2name(model, of, k) or k}'" for k in ids if k >= 0]
    return f"<{kind.name.removeprefix('mjEQ_').lower()}> of {' and '.join(ends)}"
