"""A jaw that stands still: where one finger closes on it, a grasp brings the tool so far aside that
the jaw is next to the object, and the finger does not push it far.

The jaw is that part of the gripper, unmoved by its joint, which a line through the tool's origin,
along its y axis, meets on one side. Distances are those of MuJoCo's contacts, which know meshes by
their hulls: a jaw whose hull slants meets an object with an edge, and that counts.
"""

from __future__ import annotations

import mujoco
import numpy as np

from rack.levels.algebra import Ints
from rack.levels.planning.payload import SIDES, Payloads
from rack.levels.planning.pose import Pose, site_pose
from rack.levels.robot.cell import Cell

GAP_M = 0.002
"""Between jaw and object before the finger closes: at 0 the jaw could come down on its edge."""
FARTHEST_M = 0.2
"""From the tool: where the search begins, and where it ends on the jaw's side."""
NEAR_M = 1e-4
"""At this distance from the jaw the search ends."""
STEPS = 200
MOVED = 1e-6
"""In a pose, from open to closed: rounding."""


class FixedJaw:
    """The jaw of a cell's gripper, and the geoms that stand still with it."""

    def __init__(self, cell: Cell, geoms: Ints, side: float) -> None:
        self._cell = cell
        self._geoms = geoms
        self._side = side  # of the tool's y axis: 1 or -1
        self._data = cell.start()

    def beside(self, tool: Pose, row: int, seen: Pose) -> Pose:
        """Return the pose of a tool that is to take object `row`, `seen` in the world, moved along
        its y axis until the jaw is next to the object."""
        here = site_pose(self._data, self._cell.tool)
        relative = here @ tool.inverse() @ seen
        along = self._side * self._data.site_xmat[self._cell.tool].reshape(3, 3)[:, 1]
        way = -FARTHEST_M
        for _ in range(STEPS):
            room = self._distance(row, Pose(relative.position + way * along, relative.quaternion))
            way += room
            if room < NEAR_M or way > FARTHEST_M:
                break
        if way > FARTHEST_M:
            return tool
        across = np.zeros(3)
        mujoco.mju_rotVecQuat(across, np.array([0.0, self._side, 0.0]), tool.quaternion)
        return Pose(tool.position - (way - GAP_M) * across, tool.quaternion)

    def _distance(self, row: int, at: Pose) -> float:
        """Return the distance of object `row` from what stands still, m; 0: they touch."""
        model = self._cell.model
        data = self._data
        address = self._cell.object_qpos[row]
        data.qpos[address : address + 7] = np.concatenate(at)
        mujoco.mj_kinematics(model, data)
        distances = [
            mujoco.mj_geomDistance(model, data, int(part), int(geom), FARTHEST_M, None)
            for part in self._cell.parts(row)
            for geom in self._geoms
        ]
        return max(0.0, float(min(distances)))


def find_fixed_jaw(cell: Cell, payloads: Payloads) -> FixedJaw | None:
    """Return the jaw that stands still; None: both sides of the gripper move, or it has none."""
    gripper = cell.gripper
    if gripper is None or not payloads.jaws:
        return None
    data = cell.start()
    poses = []
    for opening in (gripper.open, gripper.closed):
        gripper.linkage.set(data.qpos, opening)
        mujoco.mj_kinematics(cell.model, data)
        poses.append(np.hstack((data.geom_xpos, data.geom_xmat)))
    is_still = np.abs(poses[0] - poses[1]).max(axis=1) < MOVED
    still = [
        side for side, geom in zip(SIDES, payloads.jaws[0].geoms, strict=True) if is_still[geom]
    ]
    if len(still) != 1:
        return None
    solid = (cell.model.geom_contype | cell.model.geom_conaffinity) != 0
    geoms = cell.gripper_geoms
    return FixedJaw(cell, geoms[is_still[geoms] & solid[geoms]], still[0])
