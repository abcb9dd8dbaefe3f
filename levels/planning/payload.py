"""Checks whether the arm can carry an object, and handles grippers with a fixed jaw.

The weight of an object is compared with the friction of the grip and the torques of the motors. The
grip is known if a straight line through the origin of the tool, along its y axis, hits the object
and a finger on either side, as in every grasp that the task level plans. Virtual work over the
linkage, of any kind, gives the grip force from the actuator's force. If the line misses, the grip
is unknown and only the motors are checked.

Some grippers have one moving finger and a fixed jaw. For these, a grasp moves the tool sideways
until the jaw is next to the object, so that the finger does not push the object far. The jaw is the
part of the gripper which its joint does not move and which the same line hits on one side.
Distances are measured as for MuJoCo's contacts, with the convex hulls of meshes, so a jaw with a
slanted hull touches an object with an edge.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import mujoco
import numpy as np

from rack.levels.algebra import Array, Ints, norm
from rack.levels.errors import Refused
from rack.levels.messages import Error
from rack.levels.planning.pose import Pose, make_pose, read_site_pose
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics, Payload

MIN_GRIP_FACTOR = 1.5
"""Required grip as a multiple of an object's weight, to hold it while the arm accelerates. The PUMA
loses an object at 1.22."""
MAX_MOTOR_PART = 0.9
"""Part of a motor's torque that weights may use. The rest moves the arm."""
RAY_RANGE_M = 1.0
"""Distance from the tool up to which fingers and surfaces are searched."""
SIDES = (1.0, -1.0)


class Jaws(NamedTuple):
    """The fingers at one opening of the gripper."""

    opening: float  # m or rad
    gap: float  # between the fingers, m
    length: float  # of the actuator, m or rad
    geoms: tuple[int, int]  # ids of the geoms that face each other


class Payloads:
    """Checks whether the gripper and the motors of one arm can carry an object.

    Objects are identified by their row in the world model. `names` lists their names in that order.
    """

    def __init__(self, cell: Cell, names: tuple[str, ...]) -> None:
        self._cell = cell
        self._names = names
        self._dynamics = Dynamics(cell)
        self._data = cell.build_start_data()
        self.jaws = self._find_jaws()

    def check_grip(self, row: int, grip: Pose) -> None:
        """Check that friction can hold an object at `grip`, its pose in the frame of the tool.

        Raises:
            Refused: The grip is too weak. The text contains the needed and the available force.
        """
        needed = MIN_GRIP_FACTOR * self._find_mass(row) * norm(self._cell.model.opt.gravity)
        holds = self._compute_holding_force(row, grip)
        if holds is not None and holds < needed:
            raise Refused(
                Error.OVERLOAD,
                f"payload {self._format_object(row)} needs {needed:.1f} N of grip; the gripper"
                f" holds {holds:.1f} N",
            )

    def check_motors(self, row: int, grip: Pose, configurations: Array) -> None:
        """Check that the motors can carry an object.

        Args:
            row: Row of the object.
            grip: Pose of the object in the frame of the tool.
            configurations: Configurations to check, (k, joints), rad.

        Raises:
            Refused: A motor is too weak. The text contains the needed and the available torque.
        """
        model = self._cell.model
        centre = grip @ make_pose(model.body_ipos[self._cell.bodies[row]], (1.0, 0.0, 0.0, 0.0))
        payload = Payload(self._find_mass(row), centre.position)
        limit = MAX_MOTOR_PART * self._cell.bounds.torque
        for q in configurations:
            load = np.abs(self._dynamics.terms(q, np.zeros_like(q), payload).bias)
            worst = int(np.argmax(load - limit))
            if load[worst] > limit[worst]:
                raise Refused(
                    Error.OVERLOAD,
                    f"payload {self._format_object(row)} needs {load[worst]:.1f} N m of"
                    f" '{self._cell.joints[worst]}'; its motor carries {limit[worst]:.1f} N m",
                )

    def _find_mass(self, row: int) -> float:
        """Return the mass of object `row`, in kg."""
        return float(self._cell.model.body_subtreemass[self._cell.bodies[row]])

    def _format_object(self, row: int) -> str:
        """Return the name and the mass of object `row` as text."""
        return f"'{self._names[row]}' {self._find_mass(row):.3g} kg"

    def _compute_holding_force(self, row: int, grip: Pose) -> float | None:
        """Return the largest friction force on object `row`, in N.

        None if no two consecutive samples of the jaws enclose the width of the object.
        """
        width = self._measure_width(row, grip)
        # Find the last sample whose gap is wider than the object, and the first whose gap is not.
        for wide, narrow in pairwise(self.jaws):
            if wide.gap > width >= narrow.gap:
                break
        else:
            return None
        model = self._cell.model
        gripper = self._cell.gripper
        assert gripper is not None, "there are jaws"
        max_force = float(model.actuator_forcerange[gripper.actuator, 1])
        force = min(max_force, gripper.stiffness * abs(narrow.opening - gripper.closed))
        normal = force * abs(wide.length - narrow.length) / (wide.gap - narrow.gap)
        parts = self._cell.list_geoms(row)
        return normal * sum(
            max(_compute_friction(model, finger, int(geom)) for geom in parts)
            for finger in narrow.geoms
        )

    def _measure_width(self, row: int, grip: Pose) -> float:
        """Return the width of an object along the y axis of the tool, in m.

        Args:
            row: Row of the object.
            grip: Pose of the object in the frame of the tool.

        Returns:
            Width, or -inf if the axis does not intersect the object.
        """
        cell = self._cell
        data = self._data
        tool = make_pose(*read_site_pose(data, cell.tool))
        data.qpos[cell.find_pose(row)] = np.concatenate(tool @ grip)
        mujoco.mj_kinematics(cell.model, data)
        parts = cell.list_geoms(row)
        return sum(
            RAY_RANGE_M - self._find_nearest_geom(parts, RAY_RANGE_M * side, -side)[0]
            for side in SIDES
        )

    def _find_jaws(self) -> list[Jaws]:
        """Return the jaws at each sampled opening, from open to the last that leaves a gap."""
        cell = self._cell
        gripper = cell.gripper
        if gripper is None:
            return []
        linkage = gripper.linkage
        openings = linkage.openings
        if openings[0] != gripper.open:
            openings = openings[::-1]
        hand = cell.model.jnt_bodyid[cell.model.jnt_qposadr == linkage.driven]
        fingers = np.setdiff1d(
            cell.geoms.gripper,
            np.flatnonzero(cell.model.geom_bodyid == cell.model.body_parentid[hand]),
        )
        # If only one finger moves, the other jaw belongs to the body that carries the finger.
        return self._sample_jaws(fingers, openings) or self._sample_jaws(
            cell.geoms.gripper, openings
        )

    def _sample_jaws(self, fingers: Ints, openings: Array) -> list[Jaws]:
        """Return the jaws that geoms form at each opening, until one leaves no gap between them.

        Args:
            fingers: Ids of the geoms that may form the jaws.
            openings: Openings, from open to closed, m or rad.
        """
        cell = self._cell
        data = self._data
        gripper = cell.gripper
        assert gripper is not None, "there are openings"
        jaws: list[Jaws] = []
        for opening in openings:
            gripper.linkage.set_opening(data.qpos, float(opening))
            mujoco.mj_fwdPosition(cell.model, data)
            sides = [self._find_nearest_geom(fingers, 0.0, side) for side in SIDES]
            gap = sides[0][0] + sides[1][0]
            # When closed, the tool's origin is inside a finger, and the ray hits the far side of
            # that finger, so the gap seems to grow.
            if not np.isfinite(gap) or (jaws and gap >= jaws[-1].gap):
                break
            length = float(data.actuator_length[gripper.actuator])
            jaws.append(Jaws(float(opening), gap, length, (sides[0][1], sides[1][1])))
        return jaws

    def _find_nearest_geom(self, geoms: Ints, start: float, direction: float) -> tuple[float, int]:
        """Find the first geom that a ray along the y axis of the tool hits.

        Args:
            geoms: Ids of the geoms to test.
            start: Start of the ray on that axis, m.
            direction: Direction of the ray, 1 or -1.

        Returns:
            Distance, m, and id of the geom. The distance is inf if the ray hits none.
        """
        model = self._cell.model
        data = self._data
        tool = self._cell.tool
        axis = data.site_xmat[tool].reshape(3, 3)[:, 1].copy()
        begin = data.site_xpos[tool] + start * axis
        along = direction * axis
        nearest = (np.inf, -1)
        for geom in geoms:
            kind = int(model.geom_type[geom])
            if kind == mujoco.mjtGeom.mjGEOM_MESH:
                distance = mujoco.mj_rayMesh(model, data, int(geom), begin, along)
            else:
                at = data.geom_xpos[geom]
                turned = data.geom_xmat[geom]
                distance = mujoco.mju_rayGeom(at, turned, model.geom_size[geom], begin, along, kind)
            if 0.0 <= distance < nearest[0]:
                nearest = (float(distance), int(geom))
        return nearest


def _compute_friction(model: mujoco.MjModel, one: int, other: int) -> float:
    """Return the sliding friction of two geoms, as MuJoCo combines it.

    It is 0 if their contact is frictionless.
    """
    priority = model.geom_priority
    highest = max(priority[one], priority[other])
    mixed = [k for k in (one, other) if priority[k] == highest]
    if max(model.geom_condim[k] for k in mixed) == 1:
        return 0.0
    return float(max(model.geom_friction[k, 0] for k in mixed))


GAP_M = 0.002
"""Gap between jaw and object before the finger closes. At 0 the jaw could land on the object."""
SEARCH_RANGE_M = 0.2
"""Distance from the tool at which the search begins, and ends on the side of the jaw."""
CONTACT_TOLERANCE_M = 1e-4
"""Distance from the jaw at which the search ends."""
MAX_SEARCH_STEPS = 200
"""Maximum number of steps of the search."""
STILL_TOLERANCE = 1e-6
"""Change in a pose, from open to closed, up to which a geom counts as fixed."""


class FixedJaw:
    """The fixed jaw of a gripper with one moving finger."""

    def __init__(self, cell: Cell, geoms: Ints, side: float) -> None:
        self._cell = cell
        self._geoms = geoms
        self._side = side  # side of the jaw on the y axis of the tool, 1 or -1
        self._data = cell.build_start_data()

    def move_beside(self, tool: Pose, row: int, object_pose: Pose) -> Pose:
        """Shift the pose of the tool along its y axis, so that the jaw is next to the object.

        Args:
            tool: Pose of the tool for the grasp.
            row: Row of the object.
            object_pose: Pose of the object in the world.

        Returns:
            The shifted pose, or `tool` if the jaw would not meet the object.
        """
        relative = read_site_pose(self._data, self._cell.tool) @ tool.inverse() @ object_pose
        along = self._side * self._data.site_xmat[self._cell.tool].reshape(3, 3)[:, 1]
        travel = -SEARCH_RANGE_M
        for _ in range(MAX_SEARCH_STEPS):
            distance = self._measure_distance(
                row, Pose(relative.position + travel * along, relative.quaternion)
            )
            travel += distance
            if distance < CONTACT_TOLERANCE_M or travel > SEARCH_RANGE_M:
                break
        if travel > SEARCH_RANGE_M:
            return tool
        across = tool.rotate_vector((0.0, self._side, 0.0))
        return Pose(tool.position - (travel - GAP_M) * across, tool.quaternion)

    def _measure_distance(self, row: int, at: Pose) -> float:
        """Return the distance of an object from the jaw, in m. 0 if they touch.

        Args:
            row: Row of the object.
            at: Pose of the object in the world.
        """
        model = self._cell.model
        data = self._data
        data.qpos[self._cell.find_pose(row)] = np.concatenate(at)
        mujoco.mj_kinematics(model, data)
        distances = [
            mujoco.mj_geomDistance(model, data, int(part), int(geom), SEARCH_RANGE_M, None)
            for part in self._cell.list_geoms(row)
            for geom in self._geoms
        ]
        return max(0.0, float(min(distances)))


def find_fixed_jaw(cell: Cell, payloads: Payloads) -> FixedJaw | None:
    """Return the fixed jaw of the gripper, or None if both sides move or there is no gripper."""
    gripper = cell.gripper
    if gripper is None or not payloads.jaws:
        return None
    data = cell.build_start_data()
    poses = []
    for opening in (gripper.open, gripper.closed):
        gripper.linkage.set_opening(data.qpos, opening)
        mujoco.mj_kinematics(cell.model, data)
        poses.append(np.hstack((data.geom_xpos, data.geom_xmat)))
    is_still = np.abs(poses[0] - poses[1]).max(axis=1) < STILL_TOLERANCE
    fixed_sides = [
        side for side, geom in zip(SIDES, payloads.jaws[0].geoms, strict=True) if is_still[geom]
    ]
    if len(fixed_sides) != 1:
        return None
    solid = (cell.model.geom_contype | cell.model.geom_conaffinity) != 0
    geoms = cell.geoms.gripper
    return FixedJaw(cell, geoms[is_still[geoms] & solid[geoms]], fixed_sides[0])
