"""Your own arm hardware, driven by the servo level in place of MuJoCo."""

from __future__ import annotations

import numpy as np
from drives import Drives
from numpy.typing import NDArray

from rack.levels.arm import Arm, DriveState, Sensed
from rack.levels.level import Finding
from rack.levels.messages import ArmState
from rack.levels.robot.cell import Cell
from rack.levels.tables import SceneConfig

Array = NDArray[np.float64]


class HardwareArm(Arm):
    """Passes torques to the drives and returns their samples."""

    def __init__(
        self, cell: Cell, scene: SceneConfig, clock_ns: int, every: int = 1, seed: int = 0
    ) -> None:
        super().__init__(cell, scene, clock_ns, every, seed)
        self.drives = Drives(cell, clock_ns * 1e-9, self.patience)

    def sense(self) -> Sensed:
        """Return the newest sample."""
        drives = self.drives
        return Sensed(drives.position - drives.zero, drives.velocity.copy(), 0.0, 0.0, self.tick)

    def enable(self) -> None:
        """Enable the drives."""
        self.drives.enable()

    def disable(self) -> None:
        """Disable the drives."""
        self.drives.leave(DriveState.DISABLED)

    def reset(self) -> None:
        """Reset a fault of the drives."""
        self.drives.leave(DriveState.DISABLED)

    def weaken(self, most: Array | None) -> None:
        """Simulate a motor fault: if a torque limit in `most` is 0, its drive reports a fault."""
        if most is not None and not most.all():
            self.drives.leave(DriveState.FAULT, f"drive {most.argmin() + 1}: motor phase open")

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Pass on torques, or brake if one of them is NaN or beyond its limit."""
        finding = self.refused(torque)
        if finding is None:
            self.drives.write(torque)
            self.torque = torque.copy()
            self.waited = 0
            self.braked = False
        else:
            self.brake()
        return finding

    def brake(self) -> None:
        """Engage the brakes."""
        self.drives.brake()
        self.torque = np.zeros_like(self.torque)
        self.braked = True

    def step(self, ticks: int) -> None:
        """Advance the simulated drives by some ticks."""
        self.drives.pass_ticks(ticks)
        self.tick += ticks
        self.waited += ticks
        self.state = self.drives.state
        self.fault = self.drives.fault
        if self.drives.braked and not self.braked:
            self.brake()

    def save(self, state: ArmState) -> None:
        """Save the positions and velocities, which real drives would report after a restart."""
        super().save(state)
        state.state[: 2 * len(self.torque)] = [*self.drives.position, *self.drives.velocity]

    def restore(self, state: ArmState) -> None:
        """Continue after a restart of the board."""
        super().restore(state)
        saved = state.state[: 2 * len(self.torque)].reshape(2, -1)
        self.drives.position[:], self.drives.velocity[:] = saved
        self.drives.state = self.state
        if self.state is DriveState.ENABLED:
            self.drives.zero[:] = 0.0
