"""The workstation of a hand, a host program that plans the grasp.

It reads messages and sends plans through the bus adapter. No message carries the boards' cycle
counts, so a prompt reads these from the crate's memory, word by word at their bus addresses. Boards
may be writing them at that time, in lockstep too.
"""

from __future__ import annotations

from collections.abc import Mapping
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
from rack.levels.systems.hand.messages import GRASP_PLAN, GRASP_STATUS, GraspKind
from rack.levels.tables import Positive, Table, read_params

MOVED_M = 0.003
"""Distance by which an object may move before a new plan is made."""
WORD = 8


class WorkstationParams(Table):
    """`[host.<name>.params]`: the object to grasp, and the rules of the grasp."""

    object: str
    """object to grasp, of scene.objects"""
    opposing: str
    """finger that opposes all others"""
    rules: GraspRules = GraspRules()
    """what the grasp is to be"""
    every_s: Positive = 0.2
    """longest wait between two looks at the object, s"""


class Workstation(HostProgram):
    """Plans a grasp of one object, and plans again if the object moves before it is held."""

    inputs = {
        "world": Input(WORLD_MODEL, "below.world"),
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
        self._planner = GraspPlanner(cell, p.opposing, p.rules)
        self._planned: PlannedGrasp | None = None
        self._at = np.full(3, np.inf)  # (3,), m: where the object was when a grasp was planned last

    def run(self, bus: Bus) -> None:
        """Plan until the run is over."""
        while not bus.is_over:
            bus.wait(self._params.every_s)
            self.plan(bus)

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

    def names(self, bus: Bus) -> Mapping[str, Any]:
        """Return the functions that a prompt offers."""
        return {
            "plan": lambda: self.plan(bus),
            "boards": lambda: self.boards(bus),
        }

    def boards(self, bus: Bus) -> dict[str, dict[str, int]]:
        """Return the counts of every task, from the words of its control block."""
        counts = {"cycles": Block.CYCLES, "missed": Block.MISSED, "skipped": Block.SKIPPED}
        blocks = {task: bus.address(task) for task in bus.tasks}
        return {
            task: {name: bus.words(address + WORD * word)[0] for name, word in counts.items()}
            for task, address in blocks.items()
        }
