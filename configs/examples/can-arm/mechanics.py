"""The arm's mechanics, in memory that its drives share: each drive steps its own joint.

Joints act on each other through the arm, whatever happens on the bus. So a drive finds there where
the others are, in order to solve the arm's whole equation of motion for its own acceleration. They
are stepped in processes of their own, up to a few ms apart; to its own time a drive leads them at
the speed they have. By this alone the arm differs from one stepped as a whole: by 0.5 a t^2, some
10 urad at the joints' accelerations, in what another joint feels of it.
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
"""Longest time over which another joint is led: one whose drive has died goes no further."""


class Mechanics:
    """The state of all joints."""

    def __init__(self, cell: Cell, now_s: float) -> None:
        """Start at home, braked, at `now_s`, s."""
        self.cell = cell
        joints = len(cell.home)
        memory = mmap.mmap(-1, ROWS * joints * 8)  # shared with whoever is forked from here
        table = np.frombuffer(memory).reshape(ROWS, joints)
        # (joints,) each: s, of the state; rad; rad/s; 1: the brake is engaged
        self.time, self.position, self.velocity, self.braked = table
        self.time[:] = now_s
        self.position[:] = cell.home
        self.braked[:] = 1.0


class Joint:
    """A joint, as its drive steps it."""

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
        """Return position and velocity, in `wire.UNIT`, as far as its registers go."""
        state = self._all.position[self._number], self._all.velocity[self._number]
        position, velocity = (round(np.clip(each / UNIT, -MOST, MOST)) for each in state)
        return position, velocity

    def drive(self, torque: Array) -> None:
        """Release the brake and give a torque: that of this joint in `torque`, (joints,), N m.

        What those of the others give meanwhile must fit it in time: through axes that are nearly
        parallel, one that is some ms older throws a joint about.
        """
        self._torque = torque
        self._all.braked[self._number] = 0.0

    def brake(self) -> None:
        """Engage the brake; the motor gives nothing."""
        self._all.braked[self._number] = 1.0

    def advance(self, until_s: float) -> None:
        """Let time pass until `until_s`, s; an earlier time than that of the joint changes
        nothing."""
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
        """Return the accelerations, rad/s2: joints that are braked come to rest, whatever acts."""
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
