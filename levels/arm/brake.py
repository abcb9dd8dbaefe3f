"""The drives' own stop, for when no torque command comes, or one that is no number: brake, then stand still."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from levels.dynamics import Dynamics

Array = NDArray[np.float64]

STANDSTILL = 0.01
"""Joint speed, rad/s, below which a joint holds its position."""


class Brake:
    """Stops the joints with `braking` (joints,), rad/s2, at most, and holds them where they came to rest.

    This is "safe stop 2" of IEC 61800-5-2. `stiffness`, rad/s, is the bandwidth of the hold.
    """

    def __init__(self, braking: Array, dynamics: Dynamics, stiffness: float = 20.0) -> None:
        self._braking, self._dynamics = braking, dynamics
        self._stiffness = stiffness
        self._rest: Array | None = None

    def release(self) -> None:
        """Let the arm move again."""
        self._rest = None

    def torque(self, q: Array, qd: Array) -> Array:
        """Return the torques (joints,), N m, that stop or hold the arm at state `q`, `qd`."""
        if self._rest is None:
            self._rest = q.copy()
        np.copyto(self._rest, q, where=np.abs(qd) > STANDSTILL)
        wanted = self._stiffness**2 * (self._rest - q) - 2.0 * self._stiffness * qd
        inertia, bias = self._dynamics.terms(q, qd)
        return np.asarray(inertia @ np.clip(wanted, -self._braking, self._braking) + bias)
