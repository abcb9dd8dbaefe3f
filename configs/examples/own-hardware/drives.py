"""Stand-in for the driver of a motion controller.

It has drives with encoders, brakes, a time-out, and the states of CiA 402. Replace this file with
calls of your fieldbus library. It simulates what real drives do: it integrates the equation of
motion of the arm, and engages the brakes if no torque arrived for two cycles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import solve
from rack.levels.arm import DriveState
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics

Array = NDArray[np.float64]
STEPS = 5
"""Integration steps per tick."""
ENABLING_TICKS = 100
HOMING_TICKS = 400
"""Ticks for enabling the drives, and for finding their reference before that."""


class Drives:
    """The drives of an arm."""

    def __init__(self, cell: Cell, tick_s: float, timeout_ticks: int) -> None:
        self._dynamics = Dynamics(cell)
        self._step_s = tick_s / STEPS
        self._timeout_ticks = timeout_ticks
        self.position: Array = cell.begin.copy()  # (joints,), rad
        self.velocity: Array = np.zeros_like(self.position)  # (joints,), rad/s
        self.torque: Array = np.zeros_like(self.position)  # (joints,), N m
        self.braked = True
        self._silent_ticks = 0
        self.state = DriveState.DISABLED
        self.fault = ""  # reason for FAULT
        # (joints,), rad: offset of the encoders until the drives have found their reference.
        self.zero: Array = self.position * cell.homing
        self._waited_ticks = 0  # ticks since `enable`

    def enable(self) -> None:
        """Start to enable the drives. If their reference is not known, homing comes first."""
        self.state = DriveState.ENABLING
        self._waited_ticks = -HOMING_TICKS if self.zero.any() else 0

    def leave(self, state: DriveState, fault: str = "") -> None:
        """Brake, and change to state DISABLED or FAULT."""
        self.brake()
        self.state = state
        self.fault = fault

    def write(self, torque: Array) -> None:
        """Release the brakes and apply torques, (joints,), in N m."""
        self.torque[:] = torque
        self.braked = False
        self._silent_ticks = 0

    def brake(self) -> None:
        """Engage the brakes."""
        self.braked = True
        self.velocity[:] = self.torque[:] = 0.0

    def pass_ticks(self, ticks: int) -> None:
        """Simulate the given number of ticks."""
        for _ in range(ticks):
            if self.state is DriveState.ENABLING:
                self._make_ready()
            if self._silent_ticks >= self._timeout_ticks:
                self.brake()
            if not self.braked:
                self._move()
            self._silent_ticks += 1

    def _move(self) -> None:
        """Integrate the equation of motion over one tick."""
        for _ in range(STEPS):
            inertia, bias = self._dynamics.terms(self.position, self.velocity)
            friction = self._dynamics.friction(self.velocity)
            self.velocity += self._step_s * solve(inertia, self.torque - bias - friction)
            self.position += self._step_s * self.velocity

    def _make_ready(self) -> None:
        """Advance homing and enabling by one tick."""
        self._waited_ticks += 1
        if self._waited_ticks == 0:
            self.zero[:] = 0.0
        if self._waited_ticks >= ENABLING_TICKS:
            self.state = DriveState.ENABLED
