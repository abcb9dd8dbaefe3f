"""Collisions of the arm and its load with the cell and with each other.

MuJoCo finds the close pairs of geoms. A matrix of required distances, one entry per pair, decides which of them count.
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rack.levels.algebra import Array, mat_vec
from rack.levels.planning.pose import Pose, site_pose
from rack.levels.robot.cell import Cell
from rack.levels.robot.lookup import geom_name
from rack.levels.tables import SceneConfig

MAX_TOUCH_DEPTH_M = 0.003
"""Depth of an intended contact: simulated bodies are soft and sensed poses are not exact."""
MAX_HELD_DEPTH_M = 0.01
"""Depth of a contact between a held object and its supports: the object slides by some millimetres in the gripper when
it moves fast, and its support pushes it back as it is put down."""

ANY_DISTANCE = -np.inf
"""Required distance of a pair that may overlap."""
NONE: Array = np.zeros(0)
"""Shortfalls where no pair is close."""


def place_bodies(cell: Cell, data: mujoco.MjData, positions: Array, quaternions: Array) -> None:
    """Place objects and obstacles in `data` at the world model's poses: (bodies, 3) in m, (bodies, 4) as w, x, y, z."""
    for row, address in enumerate(cell.object_qpos):
        data.qpos[address : address + 3] = positions[row]
        data.qpos[address + 3 : address + 7] = quaternions[row]
    for row, mocap in enumerate(cell.mocap, start=len(cell.object_qpos)):
        data.mocap_pos[mocap] = positions[row]
        data.mocap_quat[mocap] = quaternions[row]


class CollisionChecker:
    """Decides whether a configuration of the arm is free, on its own copy of the cell.

    The arm, with its open gripper and its load, keeps `scene.clearance` from everything else. Links may be close to
    each other and to the body that carries the arm, but must not touch. One instance serves one task; a check takes
    some microseconds.
    """

    def __init__(self, cell: Cell, scene: SceneConfig) -> None:
        self.cell = cell
        self.clearance = scene.clearance  # m
        self.held: int | None = None  # row of the object that is carried
        self._touched: int | None = None
        self._model = copy.copy(cell.model)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_resetDataKeyframe(self._model, self._data, 0)
        self._row_geoms = [np.flatnonzero(self._model.body_rootid[self._model.geom_bodyid] == b) for b in cell.bodies]
        self._offset = (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        self._tool_quaternion = np.zeros(4)
        self._short = NONE
        self._contype = self._filter_to_arm()
        self._base = self._required_distances()
        self._required = self._base.copy()

    def tool_at(self, q: Array) -> Pose:
        """Return the tool's pose at `q` (joints,), rad."""
        self._data.qpos[self.cell.qpos] = q
        mujoco.mj_kinematics(self._model, self._data)
        return site_pose(self._data, self.cell.tool)

    def place(self, positions: Array, quaternions: Array) -> None:
        """Place objects and obstacles, as `place_bodies`."""
        place_bodies(self.cell, self._data, positions, quaternions)

    def open_gripper(self, opening: float) -> None:
        """Set the gripper to `opening`, m or rad; initially it is at its widest."""
        if self.cell.linkage is not None:
            self.cell.linkage.set(self._data.qpos, opening)

    def hold(self, row: int | None, position: ArrayLike = (0, 0, 0), quaternion: ArrayLike = (1, 0, 0, 0)) -> None:
        """Carry object `row` at a pose in the tool's frame (m; w, x, y, z); None: carry nothing."""
        self.held = row
        self._offset = (np.array(position, dtype=float), np.array(quaternion, dtype=float))
        self._model.geom_contype[:] = self._contype
        if row is not None:
            self._model.geom_contype[self._row_geoms[row]] = 1
        self._apply()

    def permit(self, row: int | None, touch: bool = True) -> None:
        """Permit or forbid contact of object `row` with supports and gripper, and a gripper close to supports."""
        self._touched = row if touch else None
        self._apply()

    def free(self, q: Array, clearance: float | None = None) -> bool:
        """Return whether the arm at `q` (joints,), rad, keeps its distances. `clearance`, m, may lower the scene's."""
        short = self._shortfalls(q, clearance)
        return not (len(short) and (short > 0.0).any())

    def room(self, q: Array) -> float:
        """Return the largest clearance, in m and at most the scene's, with which `q` is free; negative: with none."""
        short = self._shortfalls(q, None)
        pairs = self._data.contact.geom
        required = self._required[pairs[:, 0], pairs[:, 1]]
        if np.any((short > 0) & (required <= 0)):
            return -1.0
        return self.clearance - max(0.0, float(np.max(short, initial=0.0)))

    def why(self, q: Array, clearance: float | None = None) -> str:
        """Name the pair of geoms that violates its distance most at `q`, and both distances; empty: `q` is free."""
        self._shortfalls(q, clearance)
        return self.nearest()

    def nearest(self) -> str:
        """Name that pair for the last configuration checked."""
        short = self._short
        if not np.any(short > 0):
            return ""
        worst = int(np.argmax(short))
        first, second = self._data.contact.geom[worst]
        distance = self._data.contact.dist[worst]
        pair = f"'{geom_name(self._model, first)}' and '{geom_name(self._model, second)}'"
        least = distance + short[worst]
        return f"{pair} are {distance * 1e3:.1f} mm apart; valid: {least * 1e3:.1f} mm"

    def _shortfalls(self, q: Array, clearance: float | None) -> Array:
        """Return by how much each close pair falls short of its required distance, in m."""
        m, d = self._model, self._data
        d.qpos[self.cell.qpos] = q
        mujoco.mj_kinematics(m, d)
        if self.held is not None:
            self._carry(self.held)
            mujoco.mj_kinematics(m, d)
        mujoco.mj_collision(m, d)
        if not d.ncon:  # the usual case
            self._short = NONE
            return NONE
        contact = d.contact
        pairs = contact.geom
        required = self._required[pairs[:, 0], pairs[:, 1]]
        if clearance is not None:
            np.minimum(required, clearance, out=required)
        self._short = np.asarray(required - contact.dist)
        return self._short

    def _carry(self, row: int) -> None:
        d, address = self._data, self.cell.object_qpos[row]
        tool = self.cell.tool
        mujoco.mju_mat2Quat(self._tool_quaternion, d.site_xmat[tool])
        d.qpos[address : address + 3] = d.site_xpos[tool] + mat_vec(d.site_xmat[tool].reshape(3, 3), self._offset[0])
        mujoco.mju_mulQuat(d.qpos[address + 3 : address + 7], self._tool_quaternion, self._offset[1])

    def _filter_to_arm(self) -> NDArray[np.int32]:
        """Restrict MuJoCo to the pairs that involve the arm, a tenth of the work. Return the contact types."""
        m = self._model
        solid = (m.geom_contype | m.geom_conaffinity) != 0
        arm = np.zeros(m.ngeom, dtype=bool)
        arm[self.cell.arm_geoms] = True
        m.geom_contype[:] = arm & solid
        m.geom_conaffinity[:] = solid
        # MuJoCo adds the margins of the two geoms: the arm's are zero, so that self-collision has none.
        m.geom_margin[:] = np.where(arm, 0.0, self.clearance)
        m.geom_gap[:] = 0.0
        m.pair_margin[:] = self.clearance
        return np.array(m.geom_contype)

    def _required_distances(self) -> Array:
        """Return (geoms, geoms), in m: the clearance between arm and cell, 0 between links that may collide."""
        m, arm = self.cell.model, self.cell.arm_geoms
        typ, affinity = m.geom_contype, m.geom_conaffinity
        collide = (typ[:, None] & affinity[None, :]) | (typ[None, :] & affinity[:, None]) != 0
        required = np.full((m.ngeom, m.ngeom), ANY_DISTANCE)
        required[arm, :] = self.clearance
        required[:, arm] = self.clearance
        own = np.union1d(arm, self._carriers())
        for some, others in ((arm, own), (own, arm)):
            required[np.ix_(some, others)] = np.where(collide[np.ix_(some, others)], 0.0, ANY_DISTANCE)
        # Links of a gripper meet at their pins, and its motion is not planned.
        required[np.ix_(self.cell.gripper_geoms, self.cell.gripper_geoms)] = ANY_DISTANCE
        return required

    def _carriers(self) -> NDArray[np.int_]:
        """Return the geoms of the fixed bodies that carry the arm: some links are always near them."""
        m = self.cell.model
        body = m.body_parentid[m.dof_bodyid[self.cell.dof[0]]]
        chain = []
        while body > 0:
            chain.append(body)
            body = m.body_parentid[body]
        return np.flatnonzero(np.isin(m.geom_bodyid, chain))

    def _apply(self) -> None:
        """Set the required distances for the held object and the one that may be touched."""
        self._required[:] = self._base
        arm, gripper, supports = self.cell.arm_geoms, self.cell.gripper_geoms, self.cell.supports
        if self.held is not None:
            held = self._row_geoms[self.held]
            self._require(held, np.arange(self._model.ngeom), self.clearance)
            self._require(held, arm, 0.0)
            self._require(held, gripper, ANY_DISTANCE)
            self._require(held, held, ANY_DISTANCE)
        if self._touched is not None:
            touched, is_held = self._row_geoms[self._touched], self._touched == self.held
            self._require(touched, gripper, ANY_DISTANCE if is_held else -MAX_TOUCH_DEPTH_M)
            self._require(touched, supports, -MAX_HELD_DEPTH_M if is_held else -MAX_TOUCH_DEPTH_M)
            self._require(gripper, supports, 0.0)

    def _require(self, some: NDArray[np.int_], others: NDArray[np.int_], distance: float) -> None:
        self._required[np.ix_(some, others)] = distance
        self._required[np.ix_(others, some)] = distance
