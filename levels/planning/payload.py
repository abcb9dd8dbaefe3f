"""Whether the arm can carry an object, and a jaw that stands still.

The weight of an object is compared with the friction of the grip and the torques of the motors. The
grip is known if a straight line through the tool's origin, along its y axis, hits the object and a
finger on either side, as in every grasp that the task level plans. Virtual work over the linkage,
of any kind, gives the force there from the actuator's. If the line misses, the grip is unknown and
only the motors are checked.

Where one finger closes on a jaw that stands still, a grasp brings the tool so far aside that the
jaw is next to the object, and the finger does not push it far. The jaw is that part of the gripper,
unmoved by its joint, which the same line meets on one side. Distances are those of MuJoCo's
contacts, which know meshes by their hulls: a jaw whose hull slants meets an object with an edge,
and that counts.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import mujoco
import numpy as np

from rack.levels.algebra import Array, Ints
from rack.levels.errors import Refused
from rack.levels.messages import Error
from rack.levels.planning.pose import Pose, pose, site_pose
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics, Payload

MIN_GRIP_FACTOR = 1.5
"""Grip required per weight of an object, to hold it while the arm accelerates: the PUMA loses one
at 1.22."""
MAX_MOTOR_PART = 0.9
"""Part of a motor's torque that weights may take: the rest moves the arm."""
RAY_RANGE_M = 1.0
"""Fingers and surfaces are searched up to this distance from the tool."""
SIDES = (1.0, -1.0)


class Jaws(NamedTuple):
    """The fingers at one opening of the gripper."""

    opening: float  # m or rad
    gap: float  # between the fingers, m
    length: float  # of the actuator, m or rad
    geoms: tuple[int, int]  # that face each other


class Payloads:
    """Checks the payloads of one arm. `names` are the objects by their rows."""

    def __init__(self, cell: Cell, names: tuple[str, ...]) -> None:
        self._cell = cell
        self._names = names
        self._dynamics = Dynamics(cell)
        self._data = cell.start()
        self._rest = np.zeros(len(cell.home))
        self.jaws = self._closing()

    def check_grip(self, row: int, grip: Pose) -> None:
        """Raise `Refused` with both forces if friction does not hold object `row` at `grip` in the
        tool's frame.
        """
        gravity = float(np.sqrt(np.sum(np.square(self._cell.model.opt.gravity))))
        needed = MIN_GRIP_FACTOR * self._mass(row) * gravity
        holds = self._holding_force(row, grip)
        if holds is not None and holds < needed:
            why = f"{needed:.1f} N of grip; the gripper holds {holds:.1f} N"
            raise Refused(Error.OVERLOAD, f"payload {self._named(row)} needs {why}")

    def check_motors(self, row: int, grip: Pose, configurations: Array) -> None:
        """Raise `Refused` with both torques if a motor cannot carry object `row` at one of (k,
        joints), rad.
        """
        model = self._cell.model
        centre = grip @ pose(model.body_ipos[self._cell.bodies[row]], (1.0, 0.0, 0.0, 0.0))
        payload = Payload(self._mass(row), centre.position)
        limit = MAX_MOTOR_PART * self._cell.bounds.torque
        for q in configurations:
            load = np.abs(self._dynamics.terms(q, self._rest, payload).bias)
            worst = int(np.argmax(load - limit))
            if load[worst] > limit[worst]:
                joint = self._cell.joints[worst]
                why = (
                    f"{load[worst]:.1f} N m of '{joint}'; its motor carries {limit[worst]:.1f} N m"
                )
                raise Refused(Error.OVERLOAD, f"payload {self._named(row)} needs {why}")

    def _mass(self, row: int) -> float:
        return float(self._cell.model.body_subtreemass[self._cell.bodies[row]])

    def _named(self, row: int) -> str:
        return f"'{self._names[row]}' {self._mass(row):.3g} kg"

    def _holding_force(self, row: int, grip: Pose) -> float | None:
        """Return the friction, N, that can carry object `row`; None: unknown."""
        width = self._width(row, grip)
        # The last jaws that are wider, and the first that are not.
        around = (pair for pair in pairwise(self.jaws) if pair[0].gap > width >= pair[1].gap)
        wide, narrow = next(around, (None, None))
        if wide is None or narrow is None:
            return None
        model = self._cell.model
        gripper = self._cell.gripper
        assert gripper is not None, "there are jaws"
        most = float(model.actuator_forcerange[gripper.actuator, 1])
        force = min(most, gripper.stiffness * abs(narrow.opening - gripper.closed))
        normal = force * abs(wide.length - narrow.length) / (wide.gap - narrow.gap)
        parts = self._cell.parts(row)
        return normal * sum(
            max(_friction(model, finger, int(part)) for part in parts) for finger in narrow.geoms
        )

    def _width(self, row: int, grip: Pose) -> float:
        """Return the width of the object on the line through the tool, m; -inf: the line misses
        it.
        """
        cell = self._cell
        data = self._data
        address = cell.object_qpos[row]
        tool = pose(*site_pose(data, cell.tool))
        data.qpos[address : address + 7] = np.concatenate(tool @ grip)
        mujoco.mj_kinematics(cell.model, data)
        parts = self._cell.parts(row)
        return sum(
            RAY_RANGE_M - self._nearest(parts, RAY_RANGE_M * side, -side)[0] for side in SIDES
        )

    def _closing(self) -> list[Jaws]:
        """Return the jaws from open to closed, while there is a gap and a finger on either side."""
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
        # A single finger closes on a jaw of the body that carries it.
        return self._jaws_of(fingers, openings) or self._jaws_of(cell.geoms.gripper, openings)

    def _jaws_of(self, fingers: Ints, openings: Array) -> list[Jaws]:
        """Return the jaws that geoms make at these openings, while there are any."""
        cell = self._cell
        data = self._data
        gripper = cell.gripper
        assert gripper is not None, "there are openings"
        jaws: list[Jaws] = []
        for opening in openings:
            gripper.linkage.set(data.qpos, float(opening))
            mujoco.mj_fwdPosition(cell.model, data)
            sides = [self._nearest(fingers, 0.0, side) for side in SIDES]
            gap = sides[0][0] + sides[1][0]
            # When closed, the tool's origin is inside a finger, and the line leaves it on the far
            # side.
            if not np.isfinite(gap) or (jaws and gap >= jaws[-1].gap):
                break
            length = float(data.actuator_length[gripper.actuator])
            jaws.append(Jaws(float(opening), gap, length, (sides[0][1], sides[1][1])))
        return jaws

    def _nearest(self, geoms: Ints, start: float, way: float) -> tuple[float, int]:
        """Return distance, m, and id of the first geom on the tool's y axis from `start`, m; inf:
        none.
        """
        model = self._cell.model
        data = self._data
        tool = self._cell.tool
        axis = data.site_xmat[tool].reshape(3, 3)[:, 1].copy()
        begin = data.site_xpos[tool] + start * axis
        along = way * axis
        found = (np.inf, -1)
        for geom in geoms:
            kind = int(model.geom_type[geom])
            if kind == mujoco.mjtGeom.mjGEOM_MESH:
                distance = mujoco.mj_rayMesh(model, data, int(geom), begin, along)
            else:
                at = data.geom_xpos[geom]
                turned = data.geom_xmat[geom]
                distance = mujoco.mju_rayGeom(at, turned, model.geom_size[geom], begin, along, kind)
            if 0.0 <= distance < found[0]:
                found = (float(distance), int(geom))
        return found


def _friction(model: mujoco.MjModel, one: int, other: int) -> float:
    """Return the sliding friction of a contact of two geoms, as MuJoCo mixes it; 0:
    frictionless.
    """
    if model.geom_priority[one] == model.geom_priority[other]:
        mixed = [one, other]
    elif model.geom_priority[one] > model.geom_priority[other]:
        mixed = [one]
    else:
        mixed = [other]
    if max(model.geom_condim[k] for k in mixed) == 1:
        return 0.0
    return float(max(model.geom_friction[k, 0] for k in mixed))


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
        its y axis until the jaw is next to the object.
        """
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
    geoms = cell.geoms.gripper
    return FixedJaw(cell, geoms[is_still[geoms] & solid[geoms]], still[0])
