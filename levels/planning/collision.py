"""Collisions of the arm and its load with the surroundings and with each other.

MuJoCo finds the close pairs of geoms. A matrix of required distances, one entry per pair, decides
which of them are collisions.
"""

from __future__ import annotations

import copy
from functools import partial

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rack.levels.algebra import Array, Ints
from rack.levels.compiled import compiled, compiled_for
from rack.levels.planning.pose import Pose, read_site_pose
from rack.levels.robot.cell import Cell
from rack.levels.robot.engine import (
    add_offset,
    build_contact_views,
    mj_collision,
    mj_kinematics,
    mju_mat_to_quat,
    mju_mul_quat,
    set_margins,
)
from rack.levels.robot.lookup import find_geom_name
from rack.levels.tables import SceneConfig

MAX_TOUCH_DEPTH_M = 0.003
"""Permitted depth of an intended contact. Simulated bodies are soft, and sensed poses inexact."""
MAX_HELD_DEPTH_M = 0.01
"""Permitted depth of a contact between a held object and its support. The object slides by some
millimetres in the gripper in fast motion, and its support pushes it back when it is put down."""

ANY_DISTANCE = -np.inf
"""Required distance of a pair that may overlap."""

LINK, GRIPPER, LOAD = 1, 2, 4
"""Contact types of the geoms of the arm and its load. All other geoms have none."""


def place_bodies(cell: Cell, data: mujoco.MjData, positions: Array, quaternions: Array) -> None:
    """Place objects and obstacles in simulation data at the poses of the world model.

    Args:
        cell: Model that the data belong to.
        data: Data to change.
        positions: (bodies, 3), m.
        quaternions: (bodies, 4), as w, x, y, z.
    """
    for row, address in enumerate(cell.object_qpos):
        data.qpos[address : address + 3] = positions[row]
        data.qpos[address + 3 : address + 7] = quaternions[row]
    for row, mocap in enumerate(cell.mocap, start=len(cell.object_qpos)):
        data.mocap_pos[mocap] = positions[row]
        data.mocap_quat[mocap] = quaternions[row]


class CollisionChecker:
    """Checks whether a configuration of the arm is free, on a copy of the cell's model.

    A configuration is free if every pair of geoms keeps its required distance. The arm, with its
    open gripper and its load, must keep `scene.clearance` from its surroundings. Links must keep
    `margin`, a distance in m, from each other and from the body that carries the arm; the first
    link may be near its base. The gripper must only keep `margin` from supports while contact with
    them is permitted. Each task needs its own instance. A check takes some microseconds.

    Attributes:
        held: Row of the object that is carried, or None.
        longest_opening: Opening at which the gripper reaches farthest. None if it does so when
            fully open.
    """

    def __init__(self, cell: Cell, scene: SceneConfig, margin: float = 0.0) -> None:
        self.cell = cell
        self.clearance = scene.clearance  # m
        self.held: int | None = None
        self._touched: int | None = None
        self._margin = margin
        self._row_geoms = [cell.list_geoms(row) for row in range(len(cell.bodies))]
        # Pose of the held object in the frame of the tool: m, then w, x, y, z.
        self._offset = np.zeros(7)
        self._model = restrict_to_arm(cell, self.clearance, margin)
        self._types = np.stack((self._model.geom_contype, self._model.geom_conaffinity))
        self._data = mujoco.MjData(self._model)
        mujoco.mj_resetDataKeyframe(self._model, self._data, 0)
        # Swinging fingers may reach farther while they close. With a load, paths are checked at
        # that opening.
        self.longest_opening = self._find_longest_opening() if margin > 0.0 else None
        self._base = compute_required_distances(cell, self._model, self.clearance, margin)
        self._required = self._base.copy()
        self._one = np.zeros((1, len(cell.qpos)))  # buffer for a single configuration
        self._least = np.inf  # m: clearance used for the last configuration checked
        m = self._model
        d = self._data
        tool = (d.site_xpos[cell.tool], d.site_xmat[cell.tool])
        arrays = cell.qpos.copy(), d.qpos, *tool, self._offset, self._required
        self._first_blocked = partial(
            find_first_blocked.load_machine_code(),
            m._address,
            d._address,
            *arrays,
            *build_contact_views(m, d),
        )

    def compute_tool_pose(self, q: Array) -> Pose:
        """Return the pose of the tool at a configuration.

        Args:
            q: Configuration, (joints,), rad.
        """
        self._data.qpos[self.cell.qpos] = q
        mujoco.mj_kinematics(self._model, self._data)
        return read_site_pose(self._data, self.cell.tool)

    def place_bodies(self, positions: Array, quaternions: Array) -> None:
        """Place objects and obstacles at the poses of the world model.

        Args:
            positions: (bodies, 3), m.
            quaternions: (bodies, 4), as w, x, y, z.
        """
        place_bodies(self.cell, self._data, positions, quaternions)

    def open_gripper(self, opening: float) -> None:
        """Set the opening of the gripper. Initially it is fully open.

        Args:
            opening: Opening, m or rad.
        """
        if self.cell.gripper is not None:
            self.cell.gripper.linkage.set_opening(self._data.qpos, opening)

    def hold_object(
        self, row: int | None, position: ArrayLike = (0, 0, 0), quaternion: ArrayLike = (1, 0, 0, 0)
    ) -> None:
        """Attach an object to the tool, or detach it.

        Args:
            row: Row of the object, or None for an empty gripper.
            position: Position in the frame of the tool, m.
            quaternion: Orientation in that frame, as w, x, y, z.
        """
        self.held = row
        if self.longest_opening is not None and (gripper := self.cell.gripper) is not None:
            opening = gripper.open if row is None else self.longest_opening
            self.open_gripper(opening)
        self._offset[:3] = position
        self._offset[3:] = quaternion
        m = self._model
        m.geom_contype[:], m.geom_conaffinity[:] = self._types
        if row is not None:
            # The load may touch the gripper. Skipping these pairs saves a fifth of the time of a
            # check.
            m.geom_contype[self._row_geoms[row]] = LOAD
            m.geom_conaffinity[self._row_geoms[row]] &= LINK
        self._update_required()

    def permit_contact(self, row: int | None) -> None:
        """Permit contact of one object with supports and gripper, and of no other object.

        While contact is permitted, the gripper only has to keep `margin` from supports.

        Args:
            row: Row of the object, or None for no object.
        """
        self._touched = row
        self._update_required()

    def is_free(self, q: Array, clearance: float = np.inf) -> bool:
        """Return True if the arm keeps its required distances at a configuration.

        Args:
            q: Configuration, (joints,), rad.
            clearance: Clearance to use if it is smaller than the scene's, m.
        """
        self._one[0] = q
        return self.find_first_blocked(self._one, clearance) == 1

    def find_first_blocked(self, path: Array, clearance: float = np.inf) -> int:
        """Find the first configuration of a path that is not free. Later ones are not checked.

        Args:
            path: Configurations, (n, joints), rad.
            clearance: Clearance to use if it is smaller than the scene's, m.

        Returns:
            Index of that configuration, or n if all are free.
        """
        self._least = clearance
        held_qpos = -1 if self.held is None else self.cell.object_qpos[self.held]
        return self._first_blocked(held_qpos, self._least, path)

    def find_clearance(self, q: Array) -> float:
        """Return the largest clearance with which a configuration is free, up to the scene's.

        Args:
            q: Configuration, (joints,), rad.

        Returns:
            Clearance, m. Negative if the configuration is not free with any clearance.
        """
        self.is_free(q)
        short = self._compute_shortfalls()
        pairs = self._data.contact.geom
        required = self._required[pairs[:, 0], pairs[:, 1]]
        close = short > 0
        if np.any(close & (required <= 0)):
            return -1.0
        # The distance of a close pair limits the clearance, even if less is required of the pair.
        lacking = short[close] + (self.clearance - required[close])
        return self.clearance - float(np.max(lacking, initial=0.0))

    def describe_collision(self, q: Array, clearance: float = np.inf) -> str:
        """Describe the worst violation at a configuration.

        Args:
            q: Configuration, (joints,), rad.
            clearance: Clearance to use if it is smaller than the scene's, m.

        Returns:
            The pair of geoms, their distance and the required distance. Empty if `q` is free.
        """
        self.is_free(q, clearance)
        return self.describe_worst_pair()

    def describe_worst_pair(self) -> str:
        """Describe the worst violation at the configuration checked last. Empty if it is free."""
        short = self._compute_shortfalls()
        if not np.any(short > 0):
            return ""
        worst = int(np.argmax(short))
        first, second = self._data.contact.geom[worst]
        distance = self._data.contact.dist[worst]
        return (
            f"'{find_geom_name(self._model, first)}' and '{find_geom_name(self._model, second)}'"
            f" are {distance * 1e3:.1f} mm apart; valid: {(distance + short[worst]) * 1e3:.1f} mm"
        )

    def _compute_shortfalls(self) -> Array:
        """Return the required minus the actual distance of each close pair of geoms, in m.

        The pairs were found at the configuration checked last. A pair with a negative value is far
        enough apart.
        """
        contact = self._data.contact
        pairs = contact.geom
        return np.asarray(
            np.minimum(self._required[pairs[:, 0], pairs[:, 1]], self._least) - contact.dist
        )

    def _find_longest_opening(self) -> float | None:
        """Find the opening at which the gripper reaches farthest along the tool.

        Returns:
            Opening, m or rad. None if the open gripper reaches farthest, or there is no gripper.
        """
        gripper = self.cell.gripper
        if gripper is None:
            return None
        data = self._data
        extents = []
        for opening in (gripper.open, *gripper.linkage.openings):
            self.open_gripper(opening)
            mujoco.mj_kinematics(self._model, data)
            axis = data.site_xmat[self.cell.tool].reshape(3, 3)[:, 2]
            extents.append(
                (compute_extent(self._model, data, self.cell.geoms.gripper, axis), opening)
            )
        self.open_gripper(gripper.open)
        reached, opening = max(extents)
        return float(opening) if reached > extents[0][0] + self._margin else None

    def _update_required(self) -> None:
        """Update the required distances for the held object and the object that may be touched."""
        self._required[:] = self._base
        arm, gripper, supports, _ = self.cell.geoms
        if self.held is not None:
            held = self._row_geoms[self.held]
            self._set_required(held, np.arange(self._model.ngeom), self.clearance)
            self._set_required(held, arm, 0.0)
            self._set_required(held, gripper, ANY_DISTANCE)
            self._set_required(held, held, ANY_DISTANCE)
        if self._touched is not None:
            touched = self._row_geoms[self._touched]
            to_gripper = to_supports = -MAX_TOUCH_DEPTH_M
            if self._touched == self.held:
                to_gripper = ANY_DISTANCE
                to_supports = -MAX_HELD_DEPTH_M
            self._set_required(touched, gripper, to_gripper)
            self._set_required(touched, supports, to_supports)
            self._set_required(gripper, supports, self._margin)

    def _set_required(self, group: Ints, other_group: Ints, distance: float) -> None:
        """Require `distance`, in m, between all geoms of one group and all geoms of another."""
        self._required[group[:, None], other_group] = distance
        self._required[other_group[:, None], group] = distance


def restrict_to_arm(cell: Cell, clearance: float, margin: float) -> mujoco.MjModel:
    """Return a copy of the model in which MuJoCo only finds close pairs that involve the arm.

    A collision check with the copy takes a tenth of the time. Pairs within the gripper are omitted.

    Args:
        cell: Cell with the model.
        clearance: Distance up to which pairs of the arm and its surroundings must be found, m.
        margin: Distance up to which pairs of links must be found, m.
    """
    model = copy.copy(cell.model)
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    arm = np.isin(np.arange(model.ngeom), cell.geoms.arm)
    model.geom_contype[:] = LINK * (arm & solid)
    model.geom_conaffinity[:] = (LINK | GRIPPER | LOAD) * solid
    model.geom_contype[cell.geoms.gripper] *= GRIPPER
    model.geom_conaffinity[cell.geoms.gripper] &= LINK
    # MuJoCo adds the margins of the two geoms, so two links are found within twice the margin.
    set_margins(model, np.where(arm, margin, clearance))
    model.geom_gap[:] = 0.0
    model.pair_margin[:] = clearance
    return model


def compute_required_distances(
    cell: Cell, restricted: mujoco.MjModel, clearance: float, margin: float
) -> Array:
    """Return the required distance of every pair of geoms.

    The arm must keep the clearance from its surroundings; links that may collide with each other
    must keep the margin. Some links are always close to each other, and links near the base are
    close to fixed bodies. Such pairs only have to keep half of the distance that they have at home.

    Args:
        cell: Cell with the model.
        restricted: Model from `restrict_to_arm`.
        clearance: Distance between arm and surroundings, m.
        margin: Distance between links, m.

    Returns:
        Distances, (geoms, geoms), m.
    """
    model = cell.model
    arm, gripper, *_ = cell.geoms
    first_link = model.dof_bodyid[cell.dof[0]]
    carriers = []
    body = model.body_parentid[first_link]
    while body > 0:
        carriers.append(body)
        body = model.body_parentid[body]
    arm_and_carriers = np.union1d(arm, np.flatnonzero(np.isin(model.geom_bodyid, carriers)))
    kinds = model.geom_contype
    affinity = model.geom_conaffinity
    collide = (kinds[:, None] & affinity[None, :]) | (kinds[None, :] & affinity[:, None]) != 0
    required = np.full((model.ngeom, model.ngeom), ANY_DISTANCE)
    required[arm, :] = required[:, arm] = clearance
    for group, other_group in ((arm, arm_and_carriers), (arm_and_carriers, arm)):
        pairs = np.ix_(group, other_group)
        required[pairs] = np.where(collide[pairs], margin, ANY_DISTANCE)
    # Links of a gripper touch at their pins, and the motion of the gripper is not planned.
    required[np.ix_(gripper, gripper)] = ANY_DISTANCE
    data = mujoco.MjData(restricted)
    mujoco.mj_resetDataKeyframe(restricted, data, 0)
    mujoco.mj_fwdPosition(restricted, data)
    is_own = np.isin(np.arange(model.ngeom), arm_and_carriers)
    is_foot = np.isin(model.body_weldid[model.geom_bodyid], (0, first_link))
    for pair, distance in zip(data.contact.geom, data.contact.dist, strict=True):
        if is_own[pair].all() or is_foot[pair].all():
            one, other = pair
            eased = min(required[one, other], max(0.5 * distance, 0.0))
            required[one, other] = required[other, one] = eased
    return required


def compute_extent(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: Ints, axis: ArrayLike
) -> float:
    """Return how far, in m, the bounding boxes of geoms reach from the origin along an axis.

    Args:
        model: Model of the geoms.
        data: Data with their poses.
        geoms: Ids of the geoms.
        axis: Unit vector, (3,).
    """
    # The half extent of a box is the product of its half sizes and the axis in its frame.
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
def find_first_blocked(  # noqa: PLR0913  # flat, as `advance` in levels/arm/substeps.py
    model: int,
    data: int,
    joints: NDArray[np.int64],  # (joints,)
    qpos: Array,
    tool: Array,  # (3,), m
    turned: Array,  # (9,)
    offset: Array,  # (7,), m, then w, x, y, z
    required: Array,  # (geoms, geoms), m
    number: NDArray[np.int32],
    geoms: NDArray[np.int32],
    distance: Array,  # m
    held: int,
    clearance: float,  # m
    path: Array,  # (n, joints), rad
) -> int:
    """Find the first configuration in which two geoms are closer than their required distance.

    Args:
        model: Address of the model.
        data: Address of the data.
        joints: Addresses of the joints in `qpos`.
        qpos: Positions in the data.
        tool: Position of the tool in the data.
        turned: Rotation matrix of the tool in the data.
        offset: Pose of the held object in the frame of the tool.
        required: Required distances.
        number: Number of contacts in its first element; see `ContactViews`.
        geoms: Pairs of geoms in contact.
        distance: Distances of the pairs.
        held: Address of the held object in `qpos`, or -1.
        clearance: Largest distance that is required.
        path: Configurations to check.

    Returns:
        Index of that configuration, or the length of `path` if there is none.
    """
    for k in range(len(path)):
        for j in range(len(joints)):
            qpos[joints[j]] = path[k, j]
        mj_kinematics(model, data)
        if held >= 0:
            carry_object(qpos[held : held + 7], tool, turned, offset)
            mj_kinematics(model, data)
        mj_collision(model, data)
        for pair in range(number[0]):
            if min(required[geoms[pair, 0], geoms[pair, 1]], clearance) - distance[pair] > 0.0:
                return k
    return len(path)


@compiled
def carry_object(pose: Array, tool: Array, turned: Array, offset: Array) -> None:
    """Set the pose of the held object from the pose of the tool.

    Args:
        pose: Output: position, m, then w, x, y, z, (7,).
        tool: Position of the tool, (3,), m.
        turned: Rotation matrix of the tool, (9,).
        offset: Pose of the object in the frame of the tool, (7,).
    """
    add_offset(tool, turned, offset, pose)
    quaternion = np.empty(4)
    mju_mat_to_quat(quaternion.ctypes.data, turned.ctypes.data)
    mju_mul_quat(pose[3:].ctypes.data, quaternion.ctypes.data, offset[3:].ctypes.data)
