"""The workstation of a hand: it plans the grasp, and draws the hand. A program of the host side.

It reads messages through the bus adapter, and sends plans the same way. The counts of the boards,
which no message carries, it reads in the crate's memory, word by word at their bus addresses: the
adapter maps it for its host. They are for the picture alone: other boards may be writing them, in
lockstep too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rack.backplane.message import Message
from rack.backplane.words import Block
from rack.levels.algebra import norm
from rack.levels.errors import LevelError
from rack.levels.host_program import Bus, HostProgram
from rack.levels.level import Input, LevelContext
from rack.levels.messages import WORLD_MODEL
from rack.levels.robot.cell import cell_of
from rack.levels.systems.hand.grasp_planner import GraspPlanner, GraspRules, PlannedGrasp
from rack.levels.systems.hand.messages import GRASP_PLAN, GRASP_STATUS, HAND_STATUS, GraspKind
from rack.levels.systems.hand.picture import HandPicture, HandScene
from rack.levels.tables import Positive, Table, read_params

MOVED_M = 0.003
"""Distance by which an object may move before a new plan is made."""
WORD = 8


class WorkstationParams(Table):
    """`[host.<name>.params]`: what is planned, and where the picture is."""

    object: str
    """object to grasp, of scene.objects"""
    opposing: str
    """finger that opposes all others"""
    rules: GraspRules = GraspRules()
    """what the grasp is to be"""
    picture: str | None = None
    """SVG file, replaced as the hand moves; {rack} stands for the rack's name; default: none"""
    every_s: Positive = 0.2
    """time between pictures, s"""


class Workstation(HostProgram):
    """Plans a grasp of one object, anew when that moves before it is held, and draws what the
    boards report."""

    inputs = {
        "world": Input(WORLD_MODEL, "below.world"),
        "hand": Input(HAND_STATUS, "below.hand"),
        "grasp": Input(GRASP_STATUS, "below.grasp"),
    }
    outputs = {"plan": GRASP_PLAN}
    params = WorkstationParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._params = p = read_params(WorkstationParams, context.params)
        if p.object not in context.scene.objects:
            known = ", ".join(context.scene.objects) or "none"
            raise LevelError(f"params.object = {p.object}: not in the scene; objects: {known}")
        self._row = context.scene.objects.index(p.object)
        cell = cell_of(context)
        assert cell.hand is not None, "a cell with a hand"
        self._hand = cell.hand
        self._planner = GraspPlanner(cell, p.opposing, p.rules)
        self._drawing = HandPicture(cell)
        self._planned: PlannedGrasp | None = None
        self._at = np.full(3, np.inf)  # (3,), m: where the object was when a grasp was planned last
        self._picture = None if p.picture is None else Path(p.picture.format(rack=context.rack))
        self._next_s = 0.0

    def run(self, bus: Bus) -> None:
        """Plan and draw until the run is over, or the grasp's program is."""
        while not bus.is_over:
            bus.wait(self._params.every_s)
            self.plan(bus)
            if bus.time_s >= self._next_s:
                self._next_s = bus.time_s + self._params.every_s
                self.draw(bus)

    def plan(self, bus: Bus) -> PlannedGrasp | None:
        """Plan and send a grasp if one is wanted; return the newest, None without one."""
        world = bus.read("world")
        status = bus.read("grasp")
        if not (world.is_there and status.is_there) or status.value.kind > GraspKind.PRESHAPE:
            return self._planned
        model: Message = world.value
        position = model.position[self._row]
        if norm(position - self._at) < MOVED_M:
            return self._planned
        self._at = position.copy()
        grasp = self._planner.plan(self._row, position, model.quaternion[self._row])
        self._planned = grasp
        if grasp is not None:
            bus.send(
                "plan",
                object=self._row,
                sensed=model.sensed,
                contact=grasp.contact,
                normal=grasp.normal,
                posture=grasp.posture,
                grip=grasp.grip,
            )
        return grasp

    def draw(self, bus: Bus) -> None:
        """Replace the picture by one of now; a reader of the file never finds a part of it."""
        hand = bus.read("hand")
        world = bus.read("world")
        if self._picture is None or not (hand.is_there and world.is_there):
            return
        contact = np.empty((0, 3)) if self._planned is None else self._planned.contact
        model: Message = world.value
        scene = HandScene(
            position=np.array(hand.value.position),
            bodies=np.array(model.position),
            quaternions=np.array(model.quaternion),
            force=-hand.value.force,
            contact=contact,
            held=self._row,
        )
        text = self._drawing.draw(scene, list(self._text(bus)))
        self._picture.parent.mkdir(parents=True, exist_ok=True)
        partial = self._picture.with_suffix(".part")
        partial.write_text(text)
        partial.replace(self._picture)

    def names(self, bus: Bus) -> Mapping[str, Any]:
        """Return what a prompt offers: `plan()`, `draw()`, and `boards()`, the counts in the
        crate's memory."""
        return {
            "plan": lambda: self.plan(bus),
            "draw": lambda: self.draw(bus),
            "boards": lambda: self.boards(bus),
        }

    def boards(self, bus: Bus) -> dict[str, dict[str, int]]:
        """Return the counts of every task, from the words of its control block."""
        counts = (Block.CYCLES, Block.MISSED, Block.SKIPPED)
        blocks = {task: bus.address(task) for task in bus.tasks}
        return {
            task: {word.name.lower(): bus.words(address + WORD * word)[0] for word in counts}
            for task, address in blocks.items()
        }

    def _text(self, bus: Bus) -> Iterator[str]:
        """Yield the lines next to the picture."""
        hand: Message = bus.read("hand").value
        yield f"{self.context.rack}, tick {bus.tick}"
        grasp = bus.read("grasp")
        if grasp.is_there:
            status = grasp.value
            kind = GraspKind(int(status.kind)).name.lower()
            yield (
                f"step {min(status.step + 1, status.steps)} of {status.steps}: {kind}, plan"
                f" {status.plan or 'none'}"
            )
            moved = f"moved {1e3 * status.moved:.1f} mm, at most {1e3 * status.farthest:.1f}"
            yield f"grip {status.grip:.1f} N, {moved}"
            yield str(status.reason)
        if self._planned is not None:
            margin = f"joints {100 * self._planned.margin:.0f} % from their ends"
            yield f"planned: grip {self._planned.grip:.1f} N, {margin}"
        for name, joints, force in zip(
            self._hand.names, self._hand.fingers, hand.force, strict=True
        ):
            pulls = hand.tension[:, joints]
            yield (f"{name}: {norm(force):.1f} N, tendons {pulls.min():.0f} to {pulls.max():.0f} N")
        yield "crate memory: cycles, missed, skipped"
        for task, counts in self.boards(bus).items():
            yield f"{task}: {', '.join(map(str, counts.values()))}"
