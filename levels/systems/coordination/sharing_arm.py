"""The simulated arm in a cell whose bodies other simulations may move: see
`rack.levels.systems.coordination.shared_bodies`.
"""

from __future__ import annotations

import numpy as np

from rack.levels.algebra import Array
from rack.levels.arm.simulated import SimulatedArm
from rack.levels.robot.cell import Cell
from rack.levels.tables import SceneConfig

POSE = 7
MOTION = 6
"""Numbers of a free body in qpos and qvel."""


class SharingArm(SimulatedArm):
    """Keeps copies of objects where it is told, between MuJoCo's ticks; within one they are bodies
    like others.

    Rows are those of the world model.
    """

    sleeps = False  # an object that is put elsewhere would not wake

    def __init__(
        self, cell: Cell, scene: SceneConfig, clock_ns: int, every: int = 1, seed: int = 0
    ) -> None:
        super().__init__(cell, scene, clock_ns, every, seed)
        self._kept: dict[int, Array] = {}  # row of a copy: where it stays, (7,)

    def is_touched(self, row: int) -> bool:
        """Return whether the gripper touches an object."""
        return bool(self._held()[self.cell.parts(row)].any())

    def pose(self, row: int) -> Array:
        """Return the pose of an object, (7,), m and quaternion, as simulated."""
        at = self.cell.object_qpos[row]
        return np.array(self._data.qpos[at : at + POSE])

    def place(self, row: int, pose: Array) -> None:
        """Put an object to a pose, (7,), at rest."""
        model = self._model
        at = self.cell.object_qpos[row]
        dof = model.body_dofadr[self.cell.bodies[row]]
        self._data.qpos[at : at + POSE] = pose
        self._data.qvel[dof : dof + MOTION] = 0.0
        if row in self._kept:
            self._kept[row] = pose

    def keep(self, row: int, kept: bool) -> None:
        """Keep an object where it is from now on, or let the simulation move it."""
        if not kept:
            self._kept.pop(row, None)
        elif row not in self._kept:
            self._kept[row] = self.pose(row)

    def _simulate(self) -> None:
        super()._simulate()
        for row, pose in self._kept.items():
            self.place(row, pose)
