"""The workstation of a hand, a host program that plans the grasp.

It reads messages and sends plans through the bus adapter. The cycle counts of the boards are not in
any message, so the prompt reads them from the crate's memory at their bus addresses. The boards may
write them at the same time, even in lockstep. The prompt also writes scratch words of the crate's
memory, of which a message tells the boards.

In a grasp, one finger opposes all others: the fingers press along one line from one side, and the
opposing finger presses from the other side. The planner tries lines in all directions across the
knuckles. It finds contacts on the object's surface by ray casting, and joint positions by inverse
kinematics. A line is possible if all tips reach their contacts, and if the hand touches nothing
before. Of the possible lines it takes the one with the largest distance of the joints from the ends
of their ranges.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from pydantic import Field

from rack.backplane.words import Block
from rack.levels.algebra import Array, norm, transposed_mat_vec
from rack.levels.errors import LevelError
from rack.levels.host_program import Bus, HostProgram, HostSender, ProgramInput, ProgramOutput
from rack.levels.level import LevelContext
from rack.levels.messages import WorldState
from rack.levels.robot.cell import Cell, build_level_cell
from rack.levels.systems.hand.kinematics import FingerKinematics
from rack.levels.systems.hand.messages import GraspKind, GraspPlan, GraspStatus, HostWords
from rack.levels.tables import NotNegative, Positive, Table, read_params

LINES = 72
"""Number of directions that are tried."""
STEPS = 60
"""Largest number of steps of inverse kinematics."""
STEP_M = 0.02
"""Largest displacement of a tip in such a step."""
REACHED_M = 0.001
"""Distance from its target at which a tip has arrived."""
OUTSIDE_M = 0.2
"""Distance from the object at which rays begin."""


class GraspRules(Table):
    """Requirements on a planned grasp."""

    pad: Positive = 0.009
    """distance between the site of a tip and the surface that it touches [m]"""
    clear: Positive = 0.02
    """distance from the object at which tips begin to close [m]"""
    pull: NotNegative = 2.0
    """pull on the object that friction must bear in addition to its weight [N]"""
    reserve: Positive = Field(1.5, ge=1.0)
    """safety factor of friction"""


@dataclass(frozen=True)
class PlannedGrasp:
    """A grasp. Points and directions are in the object's frame, with a row for each finger."""

    contact: Array  # (fingers, 3), m, on the surface
    normal: Array  # (fingers, 3), unit vectors of the tips' forces
    posture: Array  # (joints,), rad, from which the fingers close
    grip: float  # N, force of each finger except the opposing one
    margin: float  # smallest distance of a joint from an end of its range, as a fraction


class GraspPlanner:
    """Plans grasps for one hand.

    Args:
        cell: Cell with a hand.
        opposing: Name of the finger that opposes all others.
        rules: Requirements on a grasp.

    Raises:
        LevelError: The hand has no finger of that name.
    """

    def __init__(self, cell: Cell, opposing: str, rules: GraspRules) -> None:
        assert cell.hand is not None, "a cell with a hand"
        names = cell.hand.names
        if opposing not in names:
            raise LevelError(
                f"params.opposing = {opposing}: the hand has no such finger; fingers:"
                f" {', '.join(names)}"
            )
        self._cell = cell
        self._rules = rules
        self._kinematics = FingerKinematics(cell, cell.hand)
        self._data = cell.build_start_data()
        self._opposing = names.index(opposing)
        first = [joints[0] for joints in self._kinematics.joints]
        # (fingers, 3), m.
        self._bases = self._data.xanchor[cell.model.dof_jntid[cell.dof[first]]].copy()

    def plan(self, row: int, position: Array, quaternion: Array) -> PlannedGrasp | None:
        """Return the grasp farthest from the joint limits, or None if none is feasible.

        Args:
            row: Index of the object in the scene.
            position: Position of the object in the world, (3,), m.
            quaternion: Orientation of the object in the world, (4,), w first.
        """
        self._data.qpos[self._cell.find_pose(row)] = *position, *quaternion
        self._data.qpos[self._cell.qpos] = self._cell.home
        mujoco.mj_kinematics(self._cell.model, self._data)
        lines = (
            self._plan_along_line(row, 2.0 * math.pi * number / LINES) for number in range(LINES)
        )
        grasps = [grasp for grasp in lines if grasp is not None]
        return max(grasps, key=lambda grasp: grasp.margin, default=None)

    def _plan_along_line(self, row: int, angle: float) -> PlannedGrasp | None:
        """Return the grasp that closes along a line across the palm, or None if it is not feasible.

        Args:
            row: Index of the object in the scene.
            angle: Direction of the line, rad.
        """
        across, _, out = self._kinematics.rotation.T
        line = math.cos(angle) * across + math.sin(angle) * out
        contact, normal = np.zeros((2, len(self._bases), 3))
        for finger, base in enumerate(self._bases):
            direction = -line if finger != self._opposing else line
            touched = self._find_contact(row, base, direction)
            if touched is None:
                return None
            contact[finger] = touched
            normal[finger] = direction
        closed = self._find_joints(contact - self._rules.pad * normal, self._cell.home)
        if closed is None:
            return None
        posture = self._find_joints(contact - self._rules.clear * normal, closed)
        if posture is None or self._has_contact(posture):
            return None
        low, high = self._cell.limits.position.T
        margin = float((np.minimum(closed - low, high - closed) / (high - low)).min())
        body = self._cell.bodies[row]
        turned = self._data.xmat[body].reshape(3, 3)
        origin = self._data.xpos[body]
        return PlannedGrasp(
            contact=np.array([transposed_mat_vec(turned, point - origin) for point in contact]),
            normal=np.array([transposed_mat_vec(turned, direction) for direction in normal]),
            posture=posture,
            grip=self._find_grip_force(row),
            margin=margin,
        )

    def _find_contact(self, row: int, base: Array, way: Array) -> Array | None:
        """Return the point at which a ray first meets the object, (3,), in m, or None.

        Args:
            row: Index of the object in the scene.
            base: Base of the finger, (3,), m.
            way: Direction of the ray, (3,).
        """
        model = self._cell.model
        data = self._data
        body = self._cell.bodies[row]
        along = self._kinematics.rotation[:, 1]  # the knuckles' line
        centre = data.xipos[body]
        centre = centre + float(((base - centre) * along).sum()) * along
        start = centre - OUTSIDE_M * way
        nearest = math.inf
        for geom in self._cell.list_geoms(row):
            if not model.geom_contype[geom]:
                continue
            size = model.geom_size[geom]
            kind = int(model.geom_type[geom])
            distance = mujoco.mju_rayGeom(
                data.geom_xpos[geom], data.geom_xmat[geom], size, start, way, kind, None
            )
            if 0.0 <= distance < nearest:
                nearest = distance
        return None if nearest > OUTSIDE_M else start + nearest * way

    def _find_joints(self, tips: Array, start: Array) -> Array | None:
        """Return joint positions, (joints,), in rad, for given tip positions.

        The result is None if the iteration does not reach them.

        Args:
            tips: Points in the world, (fingers, 3), m.
            start: Joint positions at which the iteration starts, (joints,), rad.
        """
        kinematics = self._kinematics
        position = start.copy()
        wanted = [kinematics.to_palm_frame(point) for point in tips]
        for _ in range(STEPS):
            kinematics.set_position(position)
            ways = [point - kinematics.find_tip(finger) for finger, point in enumerate(wanted)]
            lengths = [norm(direction) for direction in ways]
            if max(lengths) < REACHED_M:
                return position
            for finger, (direction, length) in enumerate(zip(ways, lengths, strict=True)):
                homing = np.zeros(len(kinematics.joints[finger]))
                kinematics.step_towards(
                    finger, position, direction * (STEP_M / max(length, STEP_M)), homing
                )
        return None

    def _has_contact(self, position: Array) -> bool:
        """Return True if the hand touches itself or another body at the given joint positions."""
        model = self._cell.model
        data = self._data
        data.qpos[self._cell.qpos] = position
        mujoco.mj_fwdPosition(model, data)
        hand = np.isin(data.contact.geom, self._cell.geoms.gripper).any(axis=1)
        return bool((hand & (data.contact.dist < 0.0)).any())

    def _find_grip_force(self, row: int) -> float:
        """Return the force per finger, in N, at which friction carries the load.

        The load is the object's weight and the permitted pull, with a reserve.
        """
        model = self._cell.model
        body = self._cell.bodies[row]
        friction = float(model.geom_friction[self._cell.list_geoms(row), 0].max())
        weight = float(model.body_subtreemass[body]) * norm(model.opt.gravity)
        load = self._rules.reserve * (weight + self._rules.pull)
        return load / (2.0 * friction * (len(self._bases) - 1))


MOVED_M = 0.003
"""Displacement of the object after which a new plan is made."""
WORD = 8
WORDS = 8
"""Number of scratch words of the workstation, as in `HostWords`."""


class WordWrite(Table):
    """`[[host.<name>.params.writes]]`: a word that the workstation writes."""

    at: NotNegative
    """simulated or real time from the first check after which it is written [s]"""
    word: int = Field(ge=0, lt=WORDS)
    """number of the scratch word"""
    value: int = Field(ge=-(1 << 63), lt=1 << 63)
    """value, a signed 64-bit integer"""


class WorkstationParams(Table):
    """`[host.<name>.params]`: the object to grasp, and the rules of the grasp."""

    object: str
    """object to grasp, of scene.objects"""
    opposing: str
    """name of the finger that opposes all others"""
    rules: GraspRules = GraspRules()
    """requirements on the grasp"""
    every_s: Positive = 0.2
    """longest time between two checks of the object's position [s]"""
    writes: tuple[WordWrite, ...] = ()
    """words that the program writes into the crate's memory, each at its time"""


class Workstation(HostProgram):
    """Plans a grasp of one object, and plans it again if the object moves before it is gripped."""

    world = ProgramInput(WorldState, "below.world")
    grasp = ProgramInput(GraspStatus, "below.grasp")
    plan = ProgramOutput(GraspPlan)
    words = ProgramOutput(HostWords)
    params = WorkstationParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._params = p = read_params(WorkstationParams, context.params)
        if p.object not in context.scene.objects:
            known = ", ".join(context.scene.objects) or "none"
            raise LevelError(f"params.object = {p.object}: not in the scene; objects: {known}")
        self._row = context.scene.objects.index(p.object)
        self._planner = GraspPlanner(build_level_cell(context), p.opposing, p.rules)
        self._planned: PlannedGrasp | None = None
        self._at = np.full(3, np.inf)  # (3,), m: position of the object in the newest plan

    def run(self, bus: Bus) -> None:
        """Plan grasps and write words until the run is over."""
        due = sorted(self._params.writes, key=lambda write: write.at)
        start_s = bus.time_s
        while not bus.is_over:
            bus.wait(self._params.every_s)
            self.plan_grasp()
            while due and bus.time_s - start_s >= due[0].at:
                write = due.pop(0)
                CrateMemory(bus, self.words).write(bus.scratch + WORD * write.word, write.value)

    def plan_grasp(self) -> PlannedGrasp | None:
        """Plan and send a grasp if the object has moved and is not being gripped yet.

        Returns:
            The newest grasp, or None if there is none.
        """
        world = self.world.read()
        status = self.grasp.read()
        if (
            not (world.has_message and status.has_message)
            or status.message.kind > GraspKind.PRESHAPE
        ):
            return self._planned
        model = world.message
        position = model.position[self._row]
        if norm(position - self._at) < MOVED_M:
            return self._planned
        self._at = position.copy()
        grasp = self._planner.plan(self._row, position, model.quaternion[self._row])
        self._planned = grasp
        if grasp is not None:
            plan = self.plan.message
            plan.object = self._row
            plan.sensed = model.sensed
            plan.contact = grasp.contact
            plan.normal = grasp.normal
            plan.posture = grasp.posture
            plan.grip = grasp.grip
            self.plan.send()
        return grasp

    def list_prompt_names(self, bus: Bus) -> Mapping[str, Any]:
        """Return a dictionary from names to the functions that a prompt offers."""
        memory = CrateMemory(bus, self.words)
        return {
            "plan": self.plan_grasp,
            "boards": memory.boards,
            "words": memory.words,
            "write": memory.write,
        }


class CrateMemory:
    """Access of the workstation to the crate's memory, by bus address.

    Args:
        bus: The bus.
        sender: Output that tells the levels of written words.
    """

    def __init__(self, bus: Bus, sender: HostSender[HostWords]) -> None:
        self._bus = bus
        self._sender = sender

    def boards(self) -> dict[str, dict[str, int]]:
        """Return the cycle counts of every task, read from its control block."""
        counts = {"cycles": Block.CYCLES, "missed": Block.MISSED, "skipped": Block.SKIPPED}
        blocks = {task: self._bus.address(task) for task in self._bus.tasks}
        return {
            task: {name: self._bus.words(address + WORD * word)[0] for name, word in counts.items()}
            for task, address in blocks.items()
        }

    def words(self) -> dict[str, int]:
        """Return the values of the words that `write` may change, by their addresses."""
        first = self._bus.scratch
        values = enumerate(self._bus.words(first, WORDS))
        return {f"0x{first + WORD * word:06x}": value for word, value in values}

    def write(self, address: int, value: int) -> None:
        """Write one of the words that `words` lists, and send all of them to the levels.

        Raises:
            ValueError: The word may not be written, the value is no 64-bit integer, or too many
                messages wait at the adapter.
        """
        bus = self._bus
        before = bus.words(address)
        bus.write(address, value)
        self._sender.message.word[:] = bus.words(bus.scratch, WORDS)
        if not self._sender.send():
            bus.write(address, *before)
            raise ValueError("too many words wait at the adapter; try again later")
