"""Collisions of the arm and its load with the cell and with each other.

MuJoCo finds the close pairs of geoms. A matrix of required distances, one entry per pair, decides
which of them count.
"""

from __future__ import annotations

import copy
from functools import partial

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rack.levels.algebra import Array, Ints
from rack.levels.compiled import compiled, compiled_for
from rack.levels.planning.pose import Pose, site_pose
from rack.levels.robot.cell import Cell
from rack.levels.robot.engine import (
    contact_views,
    mj_collision,
    mj_kinematics,
    mju_mat_to_quat,
    mju_mul_quat,
    set_margins,
)
from rack.levels.robot.lookup import geom_name
from rack.levels.tables import SceneConfig

MAX_TOUCH_DEPTH_M = 0.003
"""Depth of an intended contact: simulated bodies are soft and sensed poses are not exact."""
MAX_HELD_DEPTH_M = 0.01
"""Depth of a contact between a held object and its supports: the object slides by some millimetres
in the gripper when it moves fast, and its support pushes it back as it is put down."""

ANY_DISTANCE = -np.inf
"""Required distance of a pair that may overlap."""

LINK, GRIPPER, LOAD = 1, 2, 4
"""Contact types of the arm's geoms and of those that it holds; all others have none."""


def place_bodies(cell: Cell, data: mujoco.MjData, positions: Array, quaternions: Array) -> None:
    """Place objects and obstacles in `data` at the world model's poses: (bodies, 3) in m, (bodies,
    4) as w, x, y, z.
    """
    for row, address in enumerate(cell.object_qpos):
        data.qpos[address : address + 3] = positions[row]
        data.qpos[address + 3 : address + 7] = quaternions[row]
    for row, mocap in enumerate(cell.mocap, start=len(cell.object_qpos)):
        data.mocap_pos[mocap] = positions[row]
        data.mocap_quat[mocap] = quaternions[row]


class CollisionChecker:
    """Decides whether a configuration of the arm is free, on its own copy of the cell.

    The arm, with its open gripper and its load, keeps `scene.clearance` from everything else. Links
    may be close to each other and to the body that carries the arm, but keep `margin`, m, as the
    gripper does from supports; the first may be near what it stands on. One instance serves one
    task; a check takes some microseconds.
    """

    def __init__(self, cell: Cell, scene: SceneConfig, margin: float = 0.0) -> None:
        self.cell = cell
        self.clearance = scene.clearance  # m
        self.held: int | None = None  # row of the object that is carried
        self._touched: int | None = None
        self._margin = margin
        self._row_geoms = [cell.parts(row) for row in range(len(cell.bodies))]
        self._offset = np.zeros(7)  # pose of the held object in the tool's frame: m; w, x, y, z
        self._model = restricted_to_arm(cell, self.clearance, margin)
        self._types = np.stack((self._model.geom_contype, self._model.geom_conaffinity))
        self._data = mujoco.MjData(self._model)
        mujoco.mj_resetDataKeyframe(self._model, self._data, 0)
        # Fingers that swing may reach farther than open as they close: a load is planned with them
        # so.
        self.longest = self._longest() if margin > 0.0 else None
        self._base = required_distances(cell, self._model, self.clearance, margin)
        self._required = self._base.copy()
        self._one = np.zeros((1, len(cell.qpos)))  # room for one configuration to check
        self._least = np.inf  # m: the clearance of the last configuration checked
        m = self._model
        d = self._data
        tool = (d.site_xpos[cell.tool], d.site_xmat[cell.tool])
        arrays = cell.qpos.copy(), d.qpos, *tool, self._offset, self._required
        self._first_blocked = partial(
            first_blocked.load(), m._address, d._address, *arrays, *contact_views(m, d)
        )

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
        if self.cell.gripper is not None:
            self.cell.gripper.linkage.set(self._data.qpos, opening)

    def hold(
        self, row: int | None, position: ArrayLike = (0, 0, 0), quaternion: ArrayLike = (1, 0, 0, 0)
    ) -> None:
        """Carry object `row` at a pose in the tool's frame (m; w, x, y, z); None: carry nothing."""
        self.held = row
        if self.longest is not None and (gripper := self.cell.gripper) is not None:
            opening = gripper.open if row is None else self.longest
            self.open_gripper(opening)
        self._offset[:3] = position
        self._offset[3:] = quaternion
        m = self._model
        m.geom_contype[:], m.geom_conaffinity[:] = self._types
        if row is not None:
            # Gripper and load meet, which is permitted and took a fifth of a check.
            m.geom_contype[self._row_geoms[row]] = LOAD
            m.geom_conaffinity[self._row_geoms[row]] &= LINK
        self._apply()

    def permit(self, row: int | None, touch: bool = True) -> None:
        """Permit or forbid contact of object `row` with supports and gripper, and a gripper close
        to supports.
        """
        self._touched = row if touch else None
        self._apply()

    def free(self, q: Array, clearance: float | None = None) -> bool:
        """Return whether the arm at `q` (joints,), rad, keeps its distances. `clearance`, m, may
        lower the scene's.
        """
        self._one[0] = q
        return self.first_blocked(self._one, clearance) == 1

    def first_blocked(self, path: Array, clearance: float | None = None) -> int:
        """Return the index of the first of the configurations `path` (n, joints), rad, that is not
        free; n: all are. Those after it are not looked at.
        """
        self._least = np.inf if clearance is None else float(clearance)
        held_qpos = -1 if self.held is None else self.cell.object_qpos[self.held]
        return self._first_blocked(held_qpos, self._least, path)

    def room(self, q: Array) -> float:
        """Return the largest clearance, in m and at most the scene's, with which `q` is free;
        negative: with none.
        """
        self.free(q)
        short = self._shortfalls()
        pairs = self._data.contact.geom
        required = self._required[pairs[:, 0], pairs[:, 1]]
        close = short > 0
        if np.any(close & (required <= 0)):
            return -1.0
        # Where less than the clearance is required, more of it is missing.
        lacking = short[close] + (self.clearance - required[close])
        return self.clearance - max(0.0, float(np.max(lacking, initial=0.0)))

    def why(self, q: Array, clearance: float | None = None) -> str:
        """Name the pair of geoms that violates its distance most at `q`, and both distances; empty:
        `q` is free.
        """
        self.free(q, clearance)
        return self.nearest()

    def nearest(self) -> str:
        """Name that pair for the last configuration checked."""
        short = self._shortfalls()
        if not np.any(short > 0):
            return ""
        worst = int(np.argmax(short))
        first, second = self._data.contact.geom[worst]
        distance = self._data.contact.dist[worst]
        pair = f"'{geom_name(self._model, first)}' and '{geom_name(self._model, second)}'"
        least = distance + short[worst]
        return f"{pair} are {distance * 1e3:.1f} mm apart; valid: {least * 1e3:.1f} mm"

    def _shortfalls(self) -> Array:
        """Return by how much each close pair of the last configuration falls short of its required
        distance, in m.
        """
        contact = self._data.contact
        pairs = contact.geom
        return np.asarray(
            np.minimum(self._required[pairs[:, 0], pairs[:, 1]], self._least) - contact.dist
        )

    def _longest(self) -> float | None:
        """Return the opening at which the gripper reaches farthest along the tool; None: when
        open.
        """
        gripper = self.cell.gripper
        if gripper is None:
            return None
        data = self._data
        found = []
        for opening in (gripper.open, *gripper.linkage.openings):
            self.open_gripper(opening)
            mujoco.mj_kinematics(self._model, data)
            axis = data.site_xmat[self.cell.tool].reshape(3, 3)[:, 2]
            found.append((farthest(self._model, data, self.cell.geoms.gripper, axis), opening))
        self.open_gripper(gripper.open)
        reached, opening = max(found)
        return float(opening) if reached > found[0][0] + self._margin else None

    def _apply(self) -> None:
        """Set the required distances for the held object and the one that may be touched."""
        self._required[:] = self._base
        arm, gripper, supports, _ = self.cell.geoms
        if self.held is not None:
            held = self._row_geoms[self.held]
            self._require(held, np.arange(self._model.ngeom), self.clearance)
            self._require(held, arm, 0.0)
            self._require(held, gripper, ANY_DISTANCE)
            self._require(held, held, ANY_DISTANCE)
        if self._touched is not None:
            touched = self._row_geoms[self._touched]
            to_gripper = to_supports = -MAX_TOUCH_DEPTH_M
            if self._touched == self.held:
                to_gripper = ANY_DISTANCE
                to_supports = -MAX_HELD_DEPTH_M
            self._require(touched, gripper, to_gripper)
            self._require(touched, supports, to_supports)
            self._require(gripper, supports, self._margin)

    def _require(self, some: Ints, others: Ints, distance: float) -> None:
        self._required[some[:, None], others] = distance
        self._required[others[:, None], some] = distance


def restricted_to_arm(cell: Cell, clearance: float, margin: float) -> mujoco.MjModel:
    """Return a model of the cell in which MuJoCo finds close pairs that involve the arm, a tenth of
    the work, but for those within the gripper.
    """
    model = copy.copy(cell.model)
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    arm = np.isin(np.arange(model.ngeom), cell.geoms.arm)
    model.geom_contype[:] = LINK * (arm & solid)
    model.geom_conaffinity[:] = (LINK | GRIPPER | LOAD) * solid
    model.geom_contype[cell.geoms.gripper] *= GRIPPER
    model.geom_conaffinity[cell.geoms.gripper] &= LINK
    # MuJoCo adds the margins of the two geoms: two links find each other within twice the margin.
    set_margins(model, np.where(arm, margin, clearance))
    model.geom_gap[:] = 0.0
    model.pair_margin[:] = clearance
    return model


def required_distances(
    cell: Cell, restricted: mujoco.MjModel, clearance: float, margin: float
) -> Array:
    """Return (geoms, geoms), in m: the clearance between arm and cell, the margin between links
    that may collide.

    Links that are close to each other at home, or the first to what is fixed, keep only half their
    distance there: some always are. So are some to the fixed bodies that carry the arm.
    """
    model = cell.model
    arm, gripper, *_ = cell.geoms
    first = model.dof_bodyid[cell.dof[0]]
    carriers = []
    body = model.body_parentid[first]
    while body > 0:
        carriers.append(body)
        body = model.body_parentid[body]
    own = np.union1d(arm, np.flatnonzero(np.isin(model.geom_bodyid, carriers)))
    kinds = model.geom_contype
    affinity = model.geom_conaffinity
    collide = (kinds[:, None] & affinity[None, :]) | (kinds[None, :] & affinity[:, None]) != 0
    required = np.full((model.ngeom, model.ngeom), ANY_DISTANCE)
    required[arm, :] = required[:, arm] = clearance
    for some, others in ((arm, own), (own, arm)):
        pairs = np.ix_(some, others)
        required[pairs] = np.where(collide[pairs], margin, ANY_DISTANCE)
    # Links of a gripper meet at their pins, and its motion is not planned.
    required[np.ix_(gripper, gripper)] = ANY_DISTANCE
    data = mujoco.MjData(restricted)
    mujoco.mj_resetDataKeyframe(restricted, data, 0)
    mujoco.mj_fwdPosition(restricted, data)
    is_own = np.isin(np.arange(model.ngeom), own)
    is_foot = np.isin(model.body_weldid[model.geom_bodyid], (0, first))
    for pair, distance in zip(data.contact.geom, data.contact.dist, strict=True):
        if is_own[pair].all() or is_foot[pair].all():
            one, other = pair
            eased = min(required[one, other], max(0.5 * distance, 0.0))
            required[one, other] = required[other, one] = eased
    return required


def farthest(model: mujoco.MjModel, data: mujoco.MjData, geoms: Ints, axis: ArrayLike) -> float:
    """Return how far bounding boxes of geoms reach along `axis` (3,), a unit vector, from the
    origin, m.
    """
    # A box's extent along an axis: its half sizes times the axis in its own frame.
    along = np.sum(data.geom_xmat[geoms].reshape(-1, 3, 3) * np.reshape(axis, (3, 1)), axis=1)
    centre = model.geom_aabb[geoms, :3]
    half = model.geom_aabb[geoms, 3:]
    reached = (
        np.sum(data.geom_xpos[geoms] * axis, axis=1)
        + np.sum(along * centre, axis=1)
        + np.sum(np.abs(along) * half, axis=1)
    )
    return float(np.max(reached))


@compiled_for(
    "i8, i8, i8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[:,::1], i4[::1], i4[:,:], "
    "f8[:], i8, f8, f8[:,::1]"
)
def first_blocked(  # noqa: PLR0913  # flat, as `advance` in levels/arm/substeps.py
    model: int,  # address
    data: int,  # address
    joints: NDArray[np.int64],  # (joints,): their addresses in qpos
    qpos: Array,
    tool: Array,  # (3,), m: where kinematics leave its position
    turned: Array,  # (9,): and its rotation
    offset: Array,  # (7,): pose of the held object in the tool's frame
    required: Array,  # (geoms, geoms), m: distances
    number: NDArray[np.int32],  # of contacts, and so on: see `ContactViews`
    geoms: NDArray[np.int32],
    distance: Array,
    held: int,  # address of the held object in qpos; -1: none
    clearance: float,  # m: greatest distance that is required
    path: Array,  # (n, joints), rad: to be checked
) -> int:
    """Bring arm and load to one configuration after another; return the index of the first in which
    a pair of geoms does not keep its distance; n: all do.
    """
    for k in range(len(path)):
        for j in range(len(joints)):
            qpos[joints[j]] = path[k, j]
        mj_kinematics(model, data)
        if held >= 0:
            carry(qpos[held : held + 7], tool, turned, offset)
            mj_kinematics(model, data)
        mj_collision(model, data)
        for pair in range(number[0]):
            if min(required[geoms[pair, 0], geoms[pair, 1]], clearance) - distance[pair] > 0.0:
                return k
    return len(path)


@compiled
def carry(pose: Array, tool: Array, turned: Array, offset: Array) -> None:
    """Set the pose of the held object (7,), by that of the tool; arguments as above."""
    for i in range(3):
        along = (
            turned[3 * i] * offset[0]
            + turned[3 * i + 1] * offset[1]
            + turned[3 * i + 2] * offset[2]
        )
        pose[i] = tool[i] + along
    quaternion = np.empty(4)
    mju_mat_to_quat(quaternion.ctypes.data, turned.ctypes.data)
    mju_mul_quat(pose[3:].ctypes.data, quaternion.ctypes.data, offset[3:].ctypes.data)
