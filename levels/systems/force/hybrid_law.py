"""The law of hybrid motion/force control for the joints of an arm.

On axes of motion the tool follows the level above. On axes of force it moves with a velocity
proportional to the force error. Raibert and Craig ("Hybrid position/force control of manipulators",
1981) split the axes in this way; they command torques, but velocities suit joints with position
servos. The wanted force is fed forward as J^T F.

The law works with the offset dq of its joint positions from those of the level above. When no axis
is an axis of force, dq stays constant, so the motion continues without a step, shifted by dq.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from pydantic import Field

from rack.levels.algebra import Array, Mask, gram, mat_vec, solve, transposed_mat_vec
from rack.levels.planning.pose import read_site_pose
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics, Payload
from rack.levels.servo.curves import Motion
from rack.levels.systems.force.messages import AXES
from rack.levels.tables import Positive, Table

DAMPING = 1e-4
"""Added to J J^T, m2 and 1. It reduces the velocity in directions in which the arm hardly moves,
less than 0.01 m/s at 1 rad/s, so that no joint is asked for more than 50 rad/s for 1 m/s. In other
directions it costs 0.25 %."""
CATCH_UP = 20.0
"""Rate at which an error on an axis of motion is corrected, 1/s. Only damping and limits cause such
errors."""


class HybridGains(Table):
    """Gains of the force loop.

    The velocity on an axis of force is `bandwidth` / `stiffness` times the force error, smoothed.
    In a contact of that stiffness the error falls by a factor of e in 1 / `bandwidth`. Smoothing is
    needed because boards that servo joints feed dry friction forward by the sign of a velocity.
    Without it, the tool of the PUMA shakes by 14 N at 200 Hz.

    Measured with the PUMA and a pad of 16 N/mm, at 200 Hz over 1 kHz: 20 N are reached without
    overshoot, within 5 % 0.2 s after the first contact, and kept within 2 N while the tool slides
    at 0.1 m/s. A loop that is 4 times as fast works as well; one that is 6 times as fast shakes
    while the tool slides.
    """

    stiffness: Positive = 10_000.0
    """stiffness of the stiffest contact, tool included [N/m]"""
    turning_stiffness: Positive = 40.0
    """stiffness of the stiffest contact about an axis [N m/rad]"""
    bandwidth: Positive = Field(10.0, le=100.0)
    """bandwidth of the force loop in that contact [rad/s]"""
    smoothing: Positive = Field(0.03, le=1.0)
    """time constant of the velocity on axes of force [s]"""


class ForceTask(NamedTuple):
    """The axes of force and the present contact. Vectors (6,) are in the task frame."""

    rotation: Array  # (3, 3), task frame in the world
    selected: Mask  # (6,), axes of force
    wanted: Array  # (6,), N, N m: wanted wrench of the tool on the surroundings
    # (6,), N, N m: present wrench of the tool. If it is None, axes of force rest.
    exerted: Array | None
    speed: Array  # (6,), m/s, rad/s: largest velocity on axes of force


class JointMotion(NamedTuple):
    """Motion for the joints, (joints,) each."""

    position: Array  # rad
    velocity: Array  # rad/s
    acceleration: Array  # rad/s2
    inertia: Array  # kg m2: diagonal of the joint-space inertia
    load: Array  # N m: torques of gravity, velocities and the wanted force


class ToolKinematics:
    """Pose and Jacobian of the tool, and the equation of motion, at a state."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._dynamics = Dynamics(cell)
        self._whole = np.zeros((AXES, cell.model.nv))

    def evaluate_at(self, position: Array, velocity: Array, payload: Payload | None = None) -> None:
        """Compute the pose, the Jacobian and the equation of motion at a state.

        Args:
            position: (joints,), rad.
            velocity: (joints,), rad/s.
            payload: Payload at the tool, or None.
        """
        self.terms = self._dynamics.terms(position, velocity, payload)
        model, data = self._dynamics.evaluated
        mujoco.mj_jacSite(model, data, self._whole[:3], self._whole[3:], self._cell.tool)
        # (6, joints), in the world's frame.
        self.jacobian: Array = np.take(self._whole, self._cell.dof, axis=1)
        self.pose = read_site_pose(data, self._cell.tool)


class HybridLaw:
    """Turns the motion of the level above into commands for the joints, cycle by cycle."""

    def __init__(self, cell: Cell, gains: HybridGains) -> None:
        self._limits = cell.limits
        joints = len(cell.dof)
        self._gain = np.repeat(
            [gains.bandwidth / gains.stiffness, gains.bandwidth / gains.turning_stiffness], 3
        )
        self._pace = gains.bandwidth
        self._smoothing_s = gains.smoothing
        self._there = ToolKinematics(cell)
        self._here = ToolKinematics(cell)
        self._by_joint = np.zeros((3, joints))
        # dq, its velocity, and the last dq without axes of force.
        self._away, self._speed, self._base = self._by_joint
        self._by_axis = np.zeros((2, AXES))
        # Wrench fed forward, N, N m, in the world frame. Velocity on the axes of force, m/s, rad/s,
        # in the task frame.
        self._forward, self._forced = self._by_axis
        # (3,), m: offset of the tool from its position without force control.
        self.offset = np.zeros(3)

    def reset_offset(self) -> None:
        """Restart at rest, with no offset from the motion of the level above."""
        for numbers in (self._by_joint, self._by_axis, self.offset):
            numbers[:] = 0.0

    @property
    def is_at_rest(self) -> bool:
        """True if the offset from the motion of the level above does not change."""
        return not self._speed.any()

    def step(
        self, motion: Motion, task: ForceTask | None, passed_s: float, payload: Payload
    ) -> JointMotion:
        """Compute the command for one cycle.

        Args:
            motion: Motion of the level above.
            task: Axes of force, or None if all axes are axes of motion.
            passed_s: Time since the last cycle.
            payload: Payload at the tool.
        """
        q = motion.position
        qd = motion.velocity
        wanted = (
            np.zeros(len(q))
            if task is None
            else self._compute_velocity(motion, task, passed_s) - qd
        )
        change = wanted - self._speed
        max_change = self._limits.acceleration * passed_s
        excess = float((np.abs(change) / max_change).max())
        before = self._speed.copy()
        if excess > 1.0:
            change /= excess
        self._speed += change
        self._away += (0.5 * passed_s) * (before + self._speed)
        low, high = self._limits.position.T
        position = np.clip(q + self._away, low, high)
        velocity = qd + self._speed
        velocity[(q + self._away < low) | (q + self._away > high)] = 0.0
        self._away[:] = position - q
        if task is None:
            self._base[:] = self._away
        gained = motion.acceleration + (self._speed - before) / passed_s
        return JointMotion(
            position,
            velocity,
            gained,
            *self._compute_loads(task, position, velocity, passed_s, payload),
        )

    def _compute_velocity(self, motion: Motion, task: ForceTask, passed_s: float) -> Array:
        """Return the joint velocities that follow the motion and the wanted force, in rad/s."""
        self._there.evaluate_at(motion.position + self._base, motion.velocity)
        self._here.evaluate_at(motion.position + self._away, motion.velocity + self._speed)
        error = self._here.pose.compute_error(self._there.pose)
        self.offset[:] = -error[:3]
        wanted = mat_vec(self._there.jacobian, motion.velocity) + CATCH_UP * error
        twist = rotate_halves(task.rotation.T, wanted)
        forced = np.zeros(AXES)
        if task.exerted is not None:
            forced = np.clip(self._gain * (task.wanted - task.exerted), -task.speed, task.speed)
        forced -= self._forced
        self._forced += min(passed_s / self._smoothing_s, 1.0) * forced
        velocity = solve_damped(
            self._here.jacobian,
            rotate_halves(task.rotation, np.where(task.selected, self._forced, twist)),
        )
        excess = float((np.abs(velocity) / self._limits.velocity).max())
        return velocity / excess if excess > 1.0 else velocity

    def _compute_loads(
        self,
        task: ForceTask | None,
        position: Array,
        velocity: Array,
        passed_s: float,
        payload: Payload,
    ) -> tuple[Array, Array]:
        """Return the inertia and the load of the joints at the commanded state, in kg m2 and N m.

        The load includes the wanted force, which is fed forward with the bandwidth of the force
        loop.
        """
        self._here.evaluate_at(position, velocity, payload)
        forward = (
            np.zeros(AXES)
            if task is None
            else rotate_halves(task.rotation, np.where(task.selected, task.wanted, 0.0))
        )
        self._forward += min(self._pace * passed_s, 1.0) * (forward - self._forward)
        inertia, bias = self._here.terms
        return inertia.diagonal(), bias + transposed_mat_vec(self._here.jacobian, self._forward)


def rotate_halves(rotation: Array, vector: Array) -> Array:
    """Rotate both halves of a vector, such as force and torque.

    Args:
        rotation: Rotation matrix, (3, 3).
        vector: Vector, (6,).
    """
    rotation = np.ascontiguousarray(rotation)
    return np.concatenate(
        (mat_vec(rotation, vector[:3].copy()), mat_vec(rotation, vector[3:].copy()))
    )


def solve_damped(jacobian: Array, twist: Array) -> Array:
    """Return the joint velocities J^T (J J^T + d)^-1 `twist`, finite near singularities.

    Args:
        jacobian: J, (6, joints).
        twist: Velocity of the tool, (6,), m/s, rad/s.

    Returns:
        Velocities, (joints,), rad/s. See `DAMPING` for d.
    """
    square = gram(np.ascontiguousarray(jacobian.T))
    square.flat[:: AXES + 1] += DAMPING
    return transposed_mat_vec(jacobian, solve(square, twist))
