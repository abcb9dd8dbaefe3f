"""Stand-in for the driver of your motion controller: six to seven drives with encoders, brakes and
a time-out.

Replace this file with calls of your fieldbus library. What the real drives do by themselves, this
one computes: it integrates the arm's equation of motion, and engages the brakes when no torque has
come for two cycles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import solve
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics

Array = NDArray[np.float64]
STEPS = 5
"""Steps of the integration per tick."""


class Drives:
    """Drives of an arm, exchanged with once per cycle."""

    def __init__(self, cell: Cell, tick_s: float, timeout_ticks: int) -> None:
        self._dynamics = Dynamics(cell)
        self._step_s = tick_s / STEPS
        self._timeout_ticks = timeout_ticks
        self.position: Array = cell.home.copy()  # (joints,), rad
        self.velocity: Array = np.zeros_like(self.position)  # (joints,), rad/s
        self.torque: Array = np.zeros_like(self.position)  # (joints,), N m
        self.braked = True
        self._silent_ticks = 0

    def write(self, torque: Array) -> None:
        """Release the brakes and apply torques, (joints,), N m."""
        self.torque[:] = torque
        self.braked = False
        self._silent_ticks = 0

    def brake(self) -> None:
        """Engage the brakes."""
        self.braked = True
        self.velocity[:] = self.torque[:] = 0.0

    def pass_ticks(self, ticks: int) -> None:
        """Let time pass: on real hardware it passes by itself."""
        for _ in range(ticks):
            if self._silent_ticks >= self._timeout_ticks:
                self.brake()
            for _ in range(0 if self.braked else STEPS):
                inertia, bias = self._dynamics.terms(self.position, self.velocity)
                friction = self._dynamics.friction(self.velocity)
                self.velocity += self._step_s * solve(inertia, self.torque - bias - friction)
                self.position += self._step_s * self.velocity
            self._silent_ticks += 1
