"""Simulated arm in a scene with bodies that other simulations may move.

See `rack.levels.systems.coordination.shared_bodies`.
"""

from __future__ import annotations

import numpy as np

from rack.levels.algebra import Array
from rack.levels.arm.simulated import SimulatedArm
from rack.levels.robot.cell import Cell
from rack.levels.tables import SceneConfig

POSE = 7
MOTION = 6
"""Numbers of values of a free body in qpos (`POSE`) and in qvel (`MOTION`)."""


class SharingArm(SimulatedArm):
    """Simulated arm that can fix copies of objects at given poses.

    A fixed copy is moved back to its pose after each tick. Within a tick it moves like any other
    body. `row` is the row of an object in the world model.
    """

    # A sleeping object would not wake when it is moved from outside.
    sleeps = False

    def __init__(
        self, cell: Cell, scene: SceneConfig, clock_ns: int, every: int = 1, seed: int = 0
    ) -> None:
        super().__init__(cell, scene, clock_ns, every, seed)
        # Pose of each fixed copy by row, (7,), m and quaternion.
        self._fixed_poses: dict[int, Array] = {}

    def is_touched(self, row: int) -> bool:
        """Return True if the gripper touches an object."""
        return bool(self._mark_held_geoms()[self.cell.list_geoms(row)].any())

    def read_pose(self, row: int) -> Array:
        """Return the simulated pose of an object, (7,): position in m and quaternion."""
        qpos_index = self.cell.object_qpos[row]
        return np.array(self._data.qpos[qpos_index : qpos_index + POSE])

    def place_object(self, row: int, pose: Array) -> None:
        """Move an object to a pose and set its velocity to zero.

        Args:
            row: Row of the object.
            pose: New pose, (7,): position in m and quaternion.
        """
        model = self._model
        qpos_index = self.cell.object_qpos[row]
        dof_index = model.body_dofadr[self.cell.bodies[row]]
        self._data.qpos[qpos_index : qpos_index + POSE] = pose
        self._data.qvel[dof_index : dof_index + MOTION] = 0.0
        if row in self._fixed_poses:
            self._fixed_poses[row] = pose

    def fix_object(self, row: int, is_fixed: bool) -> None:
        """Fix an object at its present pose, or let the simulation move it again."""
        if not is_fixed:
            self._fixed_poses.pop(row, None)
        elif row not in self._fixed_poses:
            self._fixed_poses[row] = self.read_pose(row)

    def _simulate_tick(self) -> None:
        """Simulate a tick, then move the fixed copies back to their poses."""
        super()._simulate_tick()
        for row, pose in self._fixed_poses.items():
            self.place_object(row, pose)
