"""The joints' brakes: they act without the motors, on a joint whose motor is off as well."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import mat_vec
from rack.levels.dynamics import Dynamics

Array = NDArray[np.float64]

STANDSTILL = 0.01
"""Joint speed, rad/s, below which a joint holds its position."""


class Brake:
    """Stops the joints with `braking` (joints,), rad/s2, at most, and holds them where they came to rest.

    `rest` (joints,), rad, is where that is. `stiffness`, rad/s, is the bandwidth of the hold.
    """

    def __init__(self, braking: Array, dynamics: Dynamics, stiffness: float = 20.0) -> None:
        self._braking, self._dynamics = braking, dynamics
        self._stiffness = stiffness
        self.closed = False
        self.rest: Array = np.zeros(len(braking))

    def close(self, q: Array) -> None:
        """Close at positions `q`, rad."""
        if not self.closed:
            self.closed = True
            np.copyto(self.rest, q)

    def open(self) -> None:
        """Let the arm move again."""
        self.closed = False

    def torque(self, q: Array, qd: Array) -> Array:
        """Return the torques (joints,), N m, that stop or hold the arm at state `q`, `qd`."""
        np.copyto(self.rest, q, where=np.abs(qd) > STANDSTILL)
        wanted = self._stiffness**2 * (self.rest - q) - 2.0 * self._stiffness * qd
        inertia, bias = self._dynamics.terms(q, qd)
        return np.asarray(mat_vec(inertia, np.clip(wanted, -self._braking, self._braking)) + bias)
