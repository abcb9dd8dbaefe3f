"""The mechanics of the arm, in memory that its drives share; each drive steps one joint.

The joints interact through the arm, whatever happens on the bus. A drive therefore reads the state
of all joints from shared memory, and solves the whole equation of motion for the acceleration of
its joint. The processes of the drives differ by up to a few ms, so a drive extrapolates the other
joints to its time at their velocities. The resulting error is 0.5 a t^2, about 10 urad at the
accelerations of the joints.
"""

from __future__ import annotations

import mmap

import numpy as np
from wire import MOST, UNIT

from rack.levels.algebra import Array, mat_vec, solve
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics

STEP_S = 1e-3
ROWS = 4
LEAD_S = 5e-3
"""Longest extrapolation of another joint, after which a joint without a drive stops."""


class Mechanics:
    """State of all joints."""

    def __init__(self, cell: Cell, now_s: float) -> None:
        """Start at home at time `now_s`, with brakes engaged."""
        self.cell = cell
        joints = len(cell.home)
        memory = mmap.mmap(-1, ROWS * joints * 8)  # shared with forked processes
        table = np.frombuffer(memory).reshape(ROWS, joints)
        # (joints,) each: time of the state, s; rad; rad/s; 1 if the brake is engaged
        self.time, self.position, self.velocity, self.braked = table
        self.time[:] = now_s
        self.position[:] = cell.home
        self.braked[:] = 1.0


class Joint:
    """One joint, stepped by its drive."""

    def __init__(self, mechanics: Mechanics, number: int) -> None:
        self._all = mechanics
        self._number = number
        self._dynamics = Dynamics(mechanics.cell)
        self._braking = mechanics.cell.limits.acceleration
        self._torque: Array = np.zeros(len(self._braking))

    @property
    def count(self) -> int:
        """Number of the arm's joints."""
        return len(self._braking)

    def sample(self) -> tuple[int, int]:
        """Return position and velocity in `wire.UNIT`, limited to the range of the registers."""
        state = self._all.position[self._number], self._all.velocity[self._number]
        position, velocity = (round(np.clip(each / UNIT, -MOST, MOST)) for each in state)
        return position, velocity

    def drive(self, torque: Array) -> None:
        """Release the brake and apply a torque.

        Args:
            torque: Torques of all joints, (joints,), in N m. They must belong to the same command:
                torques of different cycles would disturb joints with nearly parallel axes.
        """
        self._torque = torque
        self._all.braked[self._number] = 0.0

    def brake(self) -> None:
        """Engage the brake and switch off the torque."""
        self._all.braked[self._number] = 1.0

    def advance(self, until_s: float) -> None:
        """Step the joint to the time `until_s`. Does nothing if the joint is already past it."""
        shared = self._all
        own = self._number
        time_s = shared.time[own]
        if until_s <= time_s:
            return
        lead = np.clip(time_s - shared.time, -LEAD_S, LEAD_S)
        velocity = shared.velocity.copy()
        position = shared.position + lead * velocity
        steps = int(np.ceil((until_s - time_s) / STEP_S))
        step_s = (until_s - time_s) / steps
        for _ in range(steps):
            velocity += step_s * self._acceleration(position, velocity, step_s)
            position += step_s * velocity
        shared.position[own] = position[own]
        shared.velocity[own] = velocity[own]
        shared.time[own] = until_s

    def _acceleration(self, position: Array, velocity: Array, step_s: float) -> Array:
        """Return the accelerations in rad/s2. Braked joints decelerate regardless of the load."""
        inertia, bias = self._dynamics.terms(position, velocity)
        braked = self._all.braked > 0.0
        stopping = np.clip(-velocity / step_s, -self._braking, self._braking) * braked
        acting = self._torque - bias - self._dynamics.friction(velocity)
        acting -= mat_vec(inertia, stopping)
        free = inertia.copy()
        free[braked] = 0.0
        free[:, braked] = 0.0
        free[braked, braked] = 1.0
        return np.where(braked, stopping, solve(free, acting))
