"""A server of force and motion alone, with a board that presses on a surface like a spring."""

from __future__ import annotations

from typing import Any

import numpy as np

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message
from rack.levels.algebra import Array
from rack.levels.planning.ik import InverseKinematics
from rack.levels.planning.pose import Pose, make_pose
from rack.levels.systems.force.messages import ForceStatus, Mode, ServerRequest
from rack.levels.systems.force.server import ForceServer
from rack.levels.systems.trajectory.messages import MotionKind
from tests.levels.systems.trajectory.rig import PERIOD_S, TrajectoryRig

DOWN = (0.0, 0.0, 1.0, 0.0)
FRAME = (0.0, 0.0, 1.0, 0.0)
"""Task frame: its z axis points down, into the surface."""
HEIGHT, STEP, EDGE = 0.80, 0.012, -0.10
"""Surface, m; from y = `EDGE` on it is lower by `STEP`."""
STIFFNESS, YIELD = 6000.0, 0.002
"""Stiffness, N/m, and velocity of the board per missing force, m/s per N."""


class ServerRig(TrajectoryRig):
    """The board goes after the wanted force along z of the task frame; a guard that is struck stops
    it."""

    level_class = ForceServer
    request_type = ServerRequest
    level: ForceServer

    def __init__(self, **params: Any) -> None:
        super().__init__("penn_cell", boards=1, **params)
        self.ik = InverseKinematics(self.cell, 1)
        self.force = self.message(ForceStatus)
        self.force.sensed = -1
        self.offset = 0.0  # m, along z of the task frame
        self.floor = HEIGHT
        self.pressed: list[float] = []  # N, by cycle
        self.places: list[Array] = []  # of the tool, m, by cycle
        self.alive = True  # the client gives signs of life

    @property
    def status(self) -> Message:
        return self.written["status"]

    @property
    def mode(self) -> Mode:
        return Mode(self.status.mode)

    def comply(self, force: float = 15.0, **fields: Any) -> int:
        """Queue a COMPLY along z; return its id."""
        wanted = {"frame": FRAME, "selected": (0, 0, 1, 0, 0, 0), "wrench": (0, 0, force, 0, 0, 0)}
        return self.request(MotionKind.COMPLY, **{**wanted, **fields})

    def free(self) -> int:
        """Queue the end of compliance; return its id."""
        return self.request(MotionKind.COMPLY)

    def guard(self, force: float) -> int:
        """Queue a guard of the z axis; return its id."""
        return self.request(MotionKind.GUARD, frame=FRAME, guard=(0, 0, force, 0, 0, 0))

    def line(self, position: Any, seconds: float = 0.0) -> int:
        """Queue a straight line of the tool; return its id."""
        return self.request(MotionKind.POSE, position=position, quaternion=DOWN, segment=seconds)

    def others(self) -> dict[str, Reading]:
        return {"force": Reading(self.force, Verdict.NEW)}

    def obey(self) -> None:
        command, wanted, force, status = (
            self.written["command"],
            self.written["compliance"],
            self.force,
            self.statuses["joints0"],
        )
        if self.alive and not self.queue:
            self.queue.append(self.message(ServerRequest))
        before = status.target.copy()
        struck = force.struck == wanted.id and force.struck > 0
        follows = bool(command.due) and not struck and not status.stopped
        if follows:
            if status.holding:
                self.offset = 0.0
            if wanted.active and wanted.selected[2]:
                missing = wanted.wrench[2] + force.wrench[2]
                self.offset += PERIOD_S * float(
                    np.clip(YIELD * missing, -wanted.speed[2], wanted.speed[2])
                )
            status.target = self._joints(
                self._lowered(self.ik.compute_tool_pose(command.position)), before
            )
        status.holding, status.position = not follows, status.target
        status.target_velocity = 0.0 if not follows else (status.target - before) / PERIOD_S
        place = self.ik.compute_tool_pose(status.target).position
        floor = self.floor - STEP * (place[1] > EDGE)
        press = STIFFNESS * max(0.0, floor - float(place[2]))
        force.echo, force.sensed, force.wrench[2] = wanted.id, self.tick, -press
        if wanted.guard[2] and press > wanted.guard[2]:
            force.struck, force.axis = wanted.id, 2
        self.pressed.append(press)
        self.places.append(place)

    def _lowered(self, tool: Pose) -> Pose:
        return make_pose(tool.position - [0.0, 0.0, self.offset], tool.quaternion)

    def _joints(self, tool: Pose, near: Array) -> Array:
        found = self.ik.find_nearby(tool, near)
        assert found is not None
        return found
