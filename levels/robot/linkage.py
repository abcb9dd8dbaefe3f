"""The linkage of a gripper: one joint is driven, the others that the arm carries follow it by the
model's equalities.

MuJoCo writes every equality (a gear, a loop closed by `connect` or `weld`, a coupled tendon), and
every joint stop that is exceeded, as rows of residual and Jacobian. Gauss-Newton over them, with
springs of joints and tendons as weak rows, finds where the linkage settles. Where equalities
contradict each other or a stop, as soft couplings of tendons do, it settles between them, by their
stiffness in the simulation. It is solved once for a number of openings; a pose in between is
interpolated, which costs a cycle some microseconds. MuJoCo's own kernels add up in a fixed order:
equal models give equal poses.

An equality may not tie a joint of the arm: `check_couplings` refuses that.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from rack.levels.algebra import Array, Ints, Mask
from rack.levels.errors import RobotError
from rack.levels.robot.lookup import below
from rack.levels.robot.model import JOINT_DRIVES, SCALAR_JOINTS, listed
from rack.levels.tables import GripperConfig

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
"""An equality that stays open by more than this, in m or rad, yields: stiffness decides."""
NOT_POSED = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
ROUNDING = 1e-9
"""In the Jacobian of a tendon."""
LOOPS = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
STIFFNESS = 0
IMPEDANCE = 2
"""Columns of MuJoCo's `efc_KBIP`."""


@dataclass(frozen=True)
class Linkage:
    """Positions of a gripper's joints, by its opening."""

    driven: int  # address of the driven joint in qpos
    openings: Array  # (k,), rising, m or rad
    joints: Ints  # (n,), addresses in qpos of the joints that follow
    positions: Array  # (n, k), m or rad
    yields: bool  # couplings contradict each other or a stop: where it settles is approximate

    def set(self, qpos: Array, opening: float) -> None:
        """Set the driven joint in `qpos` to `opening`, m or rad, and all that follow it."""
        qpos[self.driven] = opening
        for address, positions in zip(self.joints, self.positions, strict=True):
            qpos[address] = np.interp(opening, self.openings, positions)


def solve_linkage(
    model: mujoco.MjModel,
    config: GripperConfig,
    hand: Mask,
    arm: Ints,
) -> Linkage:
    """Return the linkage of a gripper in the bodies `hand` (nbody,), between open and closed; `arm`
    are the arm's own joints.

    Raises `RobotError` with the equality that cannot be kept, the joint that nothing determines, or
    the motor that nothing commands.
    """
    solver = _Solver(model, config, hand, arm)
    openings = np.linspace(
        min(config.open, config.closed), max(config.open, config.closed), OPENINGS
    )
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
    return Linkage(
        solver.driven, openings, solver.joints[follows], positions[follows], solver.yields
    )


class _Solver:
    """Finds the joints of one linkage at one opening."""

    def __init__(
        self,
        model: mujoco.MjModel,
        config: GripperConfig,
        hand: Mask,
        arm: Ints,
    ) -> None:
        self._config = config
        self._model = copy.copy(model)
        self._model.opt.disableflags |= int(NOT_POSED)
        self._data = mujoco.MjData(self._model)
        joint = int(model.joint(config.joint).id)
        carried = hand[model.jnt_bodyid]
        # The body that carries the linkage may be moved by a joint of the arm itself.
        carried[arm] = carried[joint] = False
        check_commanded(model, config, carried)
        self._others = np.flatnonzero(carried & ~np.isin(model.jnt_type, SCALAR_JOINTS))
        follow = np.flatnonzero(carried & np.isin(model.jnt_type, SCALAR_JOINTS))
        self._follow = follow
        self._loose = np.ones(len(follow), dtype=bool)
        self.yields = False
        self.driven = int(model.jnt_qposadr[joint])
        self.joints = model.jnt_qposadr[follow].astype(int)
        self._dof = model.jnt_dofadr[follow]
        self._driven_dof = int(model.jnt_dofadr[joint])
        stiffness = model.jnt_stiffness[follow]
        self._stiffness = stiffness
        self._tendons = np.flatnonzero(model.tendon_stiffness > 0.0)
        # Against an equality, the stiffest spring weighs `SPRING_PART`.
        springs = (*stiffness, *model.tendon_stiffness)
        self._stiffest = max(float(np.max(springs, initial=0.0)), 1e-12) / SPRING_PART
        self._relaxed = model.qpos_spring[self.joints]

    def settle(self, start: Array, opening: float) -> Array:
        """Return qpos with the linkage settled at `opening`, searched from `start`."""
        data = self._data
        data.qpos[:] = start
        data.qpos[self.driven] = opening
        matrix = self._descend(yielding=False)
        if self.farthest()[0] > RESIDUAL:
            matrix = self._descend(yielding=True)
        step = np.zeros(len(self.joints))
        for k in np.flatnonzero(self._loose):
            # If a joint is free to move, only staying in place resists.
            mujoco.mju_cholSolve(step, matrix, DAMPING * np.eye(len(step))[k])
            self._loose[k] = step[k] > FREE_PART
        return np.array(data.qpos)

    def _descend(self, yielding: bool) -> Array:
        """Move the joints to where the rows' squares are least; return the factored matrix there.

        With `yielding` every row counts by its stiffness in the simulation.
        """
        data = self._data
        count = len(self.joints)
        matrix = np.zeros((count, count))
        slope = np.zeros(count)
        step = np.zeros(count)
        for _ in range(ITERATIONS if count else 0):
            residual, jacobian, stiffness = self._rows()
            most = self._stiffest
            if yielding:
                most = float(np.max(stiffness, initial=1e-12))
                parts = np.sqrt(stiffness / most)
                residual *= parts
                jacobian *= parts[:, None]
            springs = self._stiffness / most
            if self._tendons.size:
                stretched, pulls = self._stretched(most)
                residual = np.concatenate((residual, stretched))
                jacobian = np.concatenate((jacobian, pulls))
            mujoco.mju_mulMatTMat(matrix, jacobian, jacobian)
            mujoco.mju_mulMatTVec(slope, jacobian, residual)
            matrix += np.diag(springs + DAMPING)
            slope += springs * (data.qpos[self.joints] - self._relaxed)
            mujoco.mju_cholFactor(matrix, 0.0)
            mujoco.mju_cholSolve(step, matrix, slope)
            data.qpos[self.joints] -= step
            if float(np.max(np.abs(step))) < STEP_TOLERANCE:
                break
        return matrix

    def farthest(self) -> tuple[float, int]:
        """Return by how much the last pose leaves an equality open at most, m or rad, and its
        id.
        """
        data = self._data
        jacobian = self._jacobian()
        ours = np.any(jacobian[:, [*self._dof, self._driven_dof]] != 0.0, axis=1)
        ours &= data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        if not ours.any():
            return 0.0, -1
        worst = int(np.argmax(np.where(ours, np.abs(data.efc_pos), 0.0)))
        return abs(float(data.efc_pos[worst])), int(data.efc_id[worst])

    def check(self, opening: float) -> None:
        """Note where the last pose leaves an equality open. Raises `RobotError` for a loop."""
        away, equality = self.farthest()
        self.yields |= away > RESIDUAL
        if away > self._config.residual and self._model.eq_type[equality] in map(int, LOOPS):
            raise RobotError(
                f"robot.gripper: equality {equality_name(self._model, equality)} is {away:.4f} m"
                f" or rad off with the gripper at {opening:g}; robot.gripper.residual permits"
                f" {self._config.residual:g}"
            )

    def check_all_follow(self) -> None:
        """Raise `RobotError` for a joint that neither an equality nor a spring determines."""
        for joint in (*self._others, *self._follow[self._loose]):
            name = (
                self._model.joint(int(joint)).name
                or f"of body {self._model.body(self._model.jnt_bodyid[joint]).name}"
            )
            raise RobotError(
                f"robot.gripper: joint '{name}' follows nothing; name it in"
                " [[robot.gripper.follow]], or give it an equality with the driven joint, or a"
                " spring"
            )

    def _rows(self) -> tuple[Array, Array, Array]:
        """Return residuals (rows,), their Jacobian (rows, joints), and the force per residual
        (rows,) in the simulation: of equalities, and of joint stops that are exceeded.
        """
        data = self._data
        jacobian = self._jacobian()[:, self._dof]
        counts = (data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY) | (data.efc_pos < 0.0)
        rows = np.flatnonzero(counts & np.any(jacobian != 0.0, axis=1))
        law = data.efc_KBIP.reshape(-1, 4)[rows]
        stiffness = data.efc_D[rows] * law[:, STIFFNESS] * law[:, IMPEDANCE]
        return np.array(data.efc_pos[rows]), np.ascontiguousarray(jacobian[rows]), stiffness

    def _stretched(self, most: float) -> tuple[Array, Array]:
        """Return the rows of tendons that are springs, (tendons,) and (tendons, joints), their
        stiffness a part of `most`.
        """
        model = self._model
        jacobian = tendon_jacobian(model, self._data)[self._tendons]
        parts = np.sqrt(model.tendon_stiffness[self._tendons] / most)
        length = self._data.ten_length[self._tendons]
        slack = np.clip(length, *model.tendon_lengthspring[self._tendons].T)
        return parts * (length - slack), parts[:, None] * jacobian[:, self._dof]

    def _jacobian(self) -> Array:
        """Return the Jacobian (rows, nv) of all constraints at the present pose."""
        mujoco.mj_fwdPosition(self._model, self._data)
        return np.asarray(self._data.efc_J).reshape(-1, self._model.nv)


def check_commanded(model: mujoco.MjModel, config: GripperConfig, carried: Mask) -> None:
    """Raise `RobotError` for an actuator, not the gripper's own, of a joint of those `carried`
    (njnt,) by the hand.
    """
    for k in range(model.nu):
        name = model.actuator(k).name
        joint = int(model.actuator_trnid[k, 0])
        drive = mujoco.mjtTrn(int(model.actuator_trntype[k])) in JOINT_DRIVES
        if drive and carried[joint] and name != config.actuator:
            raise RobotError(
                f"robot.gripper: joint '{model.joint(joint).name}' has an actuator of its own,"
                f" '{name}', that nothing commands; name the joint in [[robot.gripper.follow]]"
            )


def equality_name(model: mujoco.MjModel, equality: int) -> str:
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


def check_couplings(model: mujoco.MjModel, joints: Sequence[str], of_bodies: bool = True) -> None:
    """Refuse a model with an equality that ties a joint of the arm.

    Planning, inverse kinematics, dynamics and the servo loop treat these joints as independent.

    Args:
        model: The compiled model.
        joints: The arm's joints.
        of_bodies: Whether to check equalities between bodies as well.

    Raises:
        RobotError: A joint of the arm is tied.
    """
    for equality in range(model.neq):
        tied = [model.joint(joint).name for joint in sorted(tied_joints(model, equality))]
        counts = of_bodies or model.eq_type[equality] not in map(int, LOOPS)
        if counts and model.eq_active0[equality] and {*tied} & {*joints}:
            raise RobotError(
                f"equality {equality_name(model, equality)} couples {listed(tied)}, but the joints"
                " of an arm are driven independently; remove it from the model (in a URDF:"
                " <mimic>), or fix the joint that has no motor"
            )


def tied_joints(model: mujoco.MjModel, equality: int) -> set[int]:
    """Return the joints that an equality ties. Bodies are tied by joints that move only one."""
    ends = np.array([model.eq_obj1id[equality], model.eq_obj2id[equality]])
    ends = ends[ends >= 0]
    kind = model.eq_type[equality]
    if kind == mujoco.mjtEq.mjEQ_JOINT:
        return set(ends.tolist())
    if kind == mujoco.mjtEq.mjEQ_TENDON:
        # The joints that change the tendons' lengths.
        data = mujoco.MjData(model)
        mujoco.mj_fwdPosition(model, data)
        moving = (np.abs(tendon_jacobian(model, data)[ends]) > ROUNDING).any(axis=0)
        return set(model.dof_jntid[moving].tolist())
    if model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE:
        ends = model.site_bodyid[ends]
    moving = [below(model, model.jnt_bodyid[[joint]])[ends] for joint in range(model.njnt)]
    return {joint for joint, moved in enumerate(moving) if 0 < moved.sum() < len(ends)}


def tendon_jacobian(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Return the Jacobian of all tendons, (tendons, nv)."""
    jacobian = np.zeros((model.ntendon, model.nv))
    mujoco.mju_sparse2dense(
        jacobian, data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind
    )
    return jacobian
