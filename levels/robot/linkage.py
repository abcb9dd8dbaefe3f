"""The linkage of a gripper: one driven joint, and other joints that follow it by equalities.

MuJoCo writes every equality (a gear, a loop closed by `connect` or `weld`, a coupled tendon), and
every joint stop that is exceeded, as rows of a residual and a Jacobian. Gauss-Newton iterations
over them, with springs of joints and tendons as weak rows, find where the linkage settles. Where
equalities contradict each other or a stop, as soft couplings of tendons do, it settles in between,
according to their stiffness in the simulation. The linkage is solved once for a number of openings.
A pose in between is interpolated, which takes some microseconds of a cycle. MuJoCo's own functions
sum in a fixed order, so that equal models give equal poses.

An equality must not tie a joint of the arm: `check_couplings` refuses that.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from rack.levels.algebra import Array, Ints, Mask
from rack.levels.errors import RobotError
from rack.levels.robot.lookup import mark_descendants
from rack.levels.robot.model import JOINT_DRIVES, SCALAR_JOINTS, format_names
from rack.levels.tables import GripperConfig

OPENINGS = 33
"""Number of openings at which the linkage is solved, evenly spaced from open to closed."""
APPROACH_STEPS = 8
"""Steps from the model's reference pose to the nearest opening.

A single step might flip a loop over to its other solution.
"""
ITERATIONS = 60
STEP_TOLERANCE = 1e-10
SPRING_WEIGHT = 1e-6
"""Weight of the stiffest spring relative to an equality."""
DAMPING = 1e-9
"""Weight of a term that keeps joints in place, for joints that nothing else determines."""
FREE_RATIO = 0.01
"""Ratio of `DAMPING` to all weights that hold a joint, above which the joint is free to move."""
YIELD_RESIDUAL = 1e-3
"""Residual of an equality, m or rad, above which it yields.

Stiffness then determines where the linkage settles.
"""
DISABLED_CONSTRAINTS = (
    mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
)
JACOBIAN_ROUNDING = 1e-9
"""Elements of a tendon's Jacobian up to this value are treated as 0."""
LOOP_EQUALITIES = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
STIFFNESS = 0
IMPEDANCE = 2
"""Columns `STIFFNESS` and `IMPEDANCE` of MuJoCo's `efc_KBIP`."""


@dataclass(frozen=True)
class Linkage:
    """Positions of a gripper's joints as functions of its opening."""

    driven: int  # address of the driven joint in qpos
    openings: Array  # (k,), increasing, m or rad
    joints: Ints  # (n,), addresses in qpos of the joints that follow
    positions: Array  # (n, k), m or rad
    yields: bool  # True if couplings contradict each other or a stop; positions are approximate

    def set_opening(self, qpos: Array, opening: float) -> None:
        """Set the joints of the linkage in `qpos` to their positions at `opening`, in m or rad."""
        qpos[self.driven] = opening
        for address, positions in zip(self.joints, self.positions, strict=True):
            qpos[address] = np.interp(opening, self.openings, positions)


def solve_linkage(
    model: mujoco.MjModel,
    config: GripperConfig,
    hand: Mask,
    arm: Ints,
) -> Linkage:
    """Solve the linkage of a gripper for openings between open and closed.

    Args:
        model: The compiled model.
        config: The `[robot.gripper]` table.
        hand: Bodies of the gripper, (nbody,).
        arm: Joints of the arm.

    Raises:
        RobotError: An equality cannot be satisfied, a joint is not determined, or a motor is not
            commanded.
    """
    solver = _Solver(model, config, hand, arm)
    openings = np.linspace(
        min(config.open, config.closed), max(config.open, config.closed), OPENINGS
    )
    reference = float(model.qpos0[solver.driven])
    first = int(np.argmin(np.abs(openings - reference)))
    positions = np.zeros((len(solver.joints), OPENINGS))
    for opening in np.linspace(reference, openings[first], APPROACH_STEPS):
        middle = solver.settle_at(model.qpos0, float(opening))
    for steps in (range(first, OPENINGS), range(first, -1, -1)):
        qpos = middle
        for k in steps:
            qpos = solver.settle_at(qpos, float(openings[k]))
            solver.check_residual(float(openings[k]))
            positions[:, k] = qpos[solver.joints]
    solver.check_all_follow()
    follows = np.any(positions != model.qpos0[solver.joints][:, None], axis=1)
    return Linkage(
        solver.driven, openings, solver.joints[follows], positions[follows], solver.yields
    )


class _Solver:
    """Finds the joint positions of one linkage at an opening."""

    def __init__(
        self,
        model: mujoco.MjModel,
        config: GripperConfig,
        hand: Mask,
        arm: Ints,
    ) -> None:
        self._config = config
        self._model = copy.copy(model)
        self._model.opt.disableflags |= int(DISABLED_CONSTRAINTS)
        self._data = mujoco.MjData(self._model)
        joint = int(model.joint(config.joint).id)
        carried = hand[model.jnt_bodyid]
        # The body that carries the linkage may be moved by a joint of the arm itself.
        carried[arm] = carried[joint] = False
        for k in range(model.nu):
            name = model.actuator(k).name
            driven = int(model.actuator_trnid[k, 0])
            is_drive = mujoco.mjtTrn(int(model.actuator_trntype[k])) in JOINT_DRIVES
            if is_drive and carried[driven] and name != config.actuator:
                raise RobotError(
                    f"robot.gripper: joint '{model.joint(driven).name}' has an actuator, '{name}',"
                    " that nothing commands; name the joint in [[robot.gripper.follow]]"
                )
        self._others = np.flatnonzero(carried & ~np.isin(model.jnt_type, SCALAR_JOINTS))
        self._follow = follow = np.flatnonzero(carried & np.isin(model.jnt_type, SCALAR_JOINTS))
        self._loose = np.ones(len(follow), dtype=bool)
        self.yields = False
        self.driven = int(model.jnt_qposadr[joint])
        self.joints = model.jnt_qposadr[follow].astype(int)
        self._dof = model.jnt_dofadr[follow]
        self._driven_dof = int(model.jnt_dofadr[joint])
        self._stiffness = stiffness = model.jnt_stiffness[follow]
        self._tendons = np.flatnonzero(model.tendon_stiffness > 0.0)
        # Relative to an equality, the stiffest spring has the weight `SPRING_WEIGHT`.
        springs = (*stiffness, *model.tendon_stiffness)
        self._stiffest = max(float(np.max(springs, initial=0.0)), 1e-12) / SPRING_WEIGHT
        self._relaxed = model.qpos_spring[self.joints]

    def settle_at(self, start: Array, opening: float) -> Array:
        """Return qpos with the linkage settled at `opening`, m or rad, searching from `start`."""
        data = self._data
        data.qpos[:] = start
        data.qpos[self.driven] = opening
        matrix = self._minimize_residual(yielding=False)
        if self.find_largest_residual()[0] > YIELD_RESIDUAL:
            matrix = self._minimize_residual(yielding=True)
        step = np.zeros(len(self.joints))
        for k in np.flatnonzero(self._loose):
            # If a joint is free to move, only `DAMPING` holds it.
            mujoco.mju_cholSolve(step, matrix, DAMPING * np.eye(len(step))[k])
            self._loose[k] = step[k] > FREE_RATIO
        return np.array(data.qpos)

    def _minimize_residual(self, yielding: bool) -> Array:
        """Minimize the sum of squared residuals. Return the factored matrix of the problem.

        If `yielding` is True, every row is weighted by its stiffness in the simulation.
        """
        data = self._data
        count = len(self.joints)
        matrix = np.zeros((count, count))
        slope = np.zeros(count)
        step = np.zeros(count)
        for _ in range(ITERATIONS if count else 0):
            residual, jacobian, stiffness = self._build_rows()
            stiffest = self._stiffest
            if yielding:
                stiffest = float(np.max(stiffness, initial=1e-12))
                parts = np.sqrt(stiffness / stiffest)
                residual *= parts
                jacobian *= parts[:, None]
            springs = self._stiffness / stiffest
            if self._tendons.size:
                stretched, pulls = self._build_tendon_rows(stiffest)
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

    def find_largest_residual(self) -> tuple[float, int]:
        """Return the largest residual of the last pose, in m or rad, and the id of its equality.

        Return 0 and -1 if no equality couples the joints.
        """
        data = self._data
        rows = np.any(self._compute_jacobian()[:, [*self._dof, self._driven_dof]] != 0.0, axis=1)
        rows &= data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        if not rows.any():
            return 0.0, -1
        worst = int(np.argmax(np.where(rows, np.abs(data.efc_pos), 0.0)))
        return abs(float(data.efc_pos[worst])), int(data.efc_id[worst])

    def check_residual(self, opening: float) -> None:
        """Set `yields` to True if an equality yields in the last pose.

        Raises:
            RobotError: A loop stays open by more than the config permits.
        """
        residual, equality = self.find_largest_residual()
        self.yields |= residual > YIELD_RESIDUAL
        if residual > self._config.residual and self._model.eq_type[equality] in map(
            int, LOOP_EQUALITIES
        ):
            raise RobotError(
                f"robot.gripper: equality {describe_equality(self._model, equality)} is off by"
                f" {residual:.4f} m or rad with the gripper at {opening:g}; robot.gripper.residual"
                f" permits {self._config.residual:g}"
            )

    def check_all_follow(self) -> None:
        """Check that an equality or a spring determines every joint.

        Raises:
            RobotError: Nothing determines a joint.
        """
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

    def _build_rows(self) -> tuple[Array, Array, Array]:
        """Return the constraint rows of equalities and of exceeded joint stops.

        Returns:
            Residuals, (rows,), their Jacobian, (rows, joints), and their stiffness in the
            simulation, (rows,).
        """
        data = self._data
        jacobian = self._compute_jacobian()[:, self._dof]
        counts = (data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY) | (data.efc_pos < 0.0)
        rows = np.flatnonzero(counts & np.any(jacobian != 0.0, axis=1))
        law = data.efc_KBIP.reshape(-1, 4)[rows]
        stiffness = data.efc_D[rows] * law[:, STIFFNESS] * law[:, IMPEDANCE]
        return np.array(data.efc_pos[rows]), np.ascontiguousarray(jacobian[rows]), stiffness

    def _build_tendon_rows(self, most: float) -> tuple[Array, Array]:
        """Return the constraint rows of tendons that act as springs.

        Args:
            most: Stiffness by which the stiffness of each tendon is divided.

        Returns:
            Residuals, (tendons,), and their Jacobian, (tendons, joints).
        """
        model = self._model
        jacobian = compute_tendon_jacobian(model, self._data)[self._tendons]
        parts = np.sqrt(model.tendon_stiffness[self._tendons] / most)
        length = self._data.ten_length[self._tendons]
        slack = np.clip(length, *model.tendon_lengthspring[self._tendons].T)
        return parts * (length - slack), parts[:, None] * jacobian[:, self._dof]

    def _compute_jacobian(self) -> Array:
        """Return the Jacobian of all constraints at the present pose, (rows, nv)."""
        mujoco.mj_fwdPosition(self._model, self._data)
        return np.asarray(self._data.efc_J).reshape(-1, self._model.nv)


def describe_equality(model: mujoco.MjModel, equality: int) -> str:
    """Return the name of an equality.

    If it has no name, return its kind and the elements that it couples.
    """
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
    """Check that no active equality of a model couples a joint of the arm.

    Planning, inverse kinematics, dynamics and the servo loop treat these joints as independent.

    Args:
        model: The compiled model.
        joints: Names of the arm's joints.
        of_bodies: True to check equalities between bodies as well.

    Raises:
        RobotError: An equality couples a joint of the arm.
    """
    for equality in range(model.neq):
        tied = [model.joint(joint).name for joint in sorted(find_coupled_joints(model, equality))]
        counts = of_bodies or model.eq_type[equality] not in map(int, LOOP_EQUALITIES)
        if counts and model.eq_active0[equality] and {*tied} & {*joints}:
            raise RobotError(
                f"equality {describe_equality(model, equality)} couples "
                f"{format_names(tied)}, but the joints"
                " of an arm are driven independently; remove it from the model (in a URDF:"
                " <mimic>), or fix the joint that has no motor"
            )


def find_coupled_joints(model: mujoco.MjModel, equality: int) -> set[int]:
    """Return the ids of the joints that an equality couples.

    An equality between two bodies couples the joints that move only one of them.
    """
    ends = np.array([model.eq_obj1id[equality], model.eq_obj2id[equality]])
    ends = ends[ends >= 0]
    kind = model.eq_type[equality]
    if kind == mujoco.mjtEq.mjEQ_JOINT:
        return set(ends.tolist())
    if kind == mujoco.mjtEq.mjEQ_TENDON:
        # Joints are tied if they change the length of a tendon.
        data = mujoco.MjData(model)
        mujoco.mj_fwdPosition(model, data)
        moving = (np.abs(compute_tendon_jacobian(model, data)[ends]) > JACOBIAN_ROUNDING).any(
            axis=0
        )
        return set(model.dof_jntid[moving].tolist())
    if model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE:
        ends = model.site_bodyid[ends]
    moving = [
        mark_descendants(model, model.jnt_bodyid[[joint]])[ends] for joint in range(model.njnt)
    ]
    return {joint for joint, moved in enumerate(moving) if 0 < moved.sum() < len(ends)}


def compute_tendon_jacobian(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Return the Jacobian of all tendons, (tendons, nv)."""
    jacobian = np.zeros((model.ntendon, model.nv))
    mujoco.mju_sparse2dense(
        jacobian, data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind
    )
    return jacobian
