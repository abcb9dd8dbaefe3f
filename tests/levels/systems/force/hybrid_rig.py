"""A trajectory level, hybrid control, a board that servoes joints, and an arm with a pad."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np

from rack.backplane.message import Message
from rack.levels.algebra import Array
from rack.levels.messages import WorldState
from rack.levels.planning.ik import InverseKinematics
from rack.levels.planning.pose import make_pose
from rack.levels.robot.cell import build_cell
from rack.levels.systems.force.arm_executor import ForceArmExecutor
from rack.levels.systems.force.hybrid import HybridExecutor
from rack.levels.systems.force.messages import Compliance
from rack.levels.systems.joint_boards import JointServo
from rack.levels.systems.trajectory import TrajectoryExecutor
from rack.levels.systems.trajectory.messages import MotionKind, MotionRequest
from tests.levels.lockstep import BoardSpec, Lockstep
from tests.levels.systems.force.pad import pad

CLOCK_NS = 1_000_000
DOWN = (0.0, 1.0, 0.0, 0.0)
"""Orientation of a tool that points straight down."""
TABLE_M = 0.45
"""Height of the table, where the tool touches it."""
START = (0.55, 0.0, TABLE_M + 0.02)


class HybridRig:
    """Runs the levels tick by tick; the test queues motions, and writes what is wanted of the
    contact."""

    def __init__(
        self, folder: Path, every: int = 5, start: Sequence[float] = START, **gains: float
    ) -> None:
        robot, scene = pad(folder)
        ik = InverseKinematics(build_cell(robot, scene, CLOCK_NS), 1)
        home = ik.find_free_solutions(make_pose(start, DOWN), np.array(robot.home), lambda q: True)[
            0
        ]
        robot = robot.model_copy(update={"home": tuple(home)})
        self.cell, self.ik = build_cell(robot, scene, CLOCK_NS), ik
        boards = [
            BoardSpec("arm", 1, ForceArmExecutor, above="servo"),
            BoardSpec("servo", 1, JointServo, above="hybrid", below="arm"),
            BoardSpec(
                "hybrid", every, HybridExecutor, above="trajectory", below="servo", params=gains
            ),
            BoardSpec("trajectory", 20, TrajectoryExecutor, above="client", below="hybrid"),
        ]
        outside = {
            "client.requests": MotionRequest,
            "trajectory.compliance": Compliance,
            "world.model": WorldState,
        }
        self.rack = Lockstep(boards, robot, scene, outside=outside, clock_ns=CLOCK_NS)
        world = self.rack.message("world.model")
        world.revision = 1
        self.rack.write("world.model", world)
        self.compliance = self.rack.message("trajectory.compliance")
        self.compliance.frame = (1.0, 0.0, 0.0, 0.0)
        self._request = self.rack.message("client.requests")
        self.forces: list[Array] = []  # (6,), of the contact on the tool
        self.targets: list[Array] = []  # (joints,), of the arm

    def line(self, position: Sequence[float], segment: float = 0.0) -> int:
        """Queue a line of the tool; return its id."""
        request = self._request
        request.id, request.kind, request.body, request.segment = (
            request.id + 1,
            MotionKind.POSE,
            -1,
            segment,
        )
        request.position, request.quaternion = position, DOWN
        self.rack.write("client.requests", request)
        return int(request.id)

    def comply(
        self, z: float | None, speed: float = 0.03, guard: Sequence[float] = (0.0,) * 6
    ) -> int:
        """Want the tool to press with a force, N, along z; None: z is an axis of motion. Return the
        command's id."""
        command = self.compliance
        command.id, command.active = command.id + 1, z is not None or any(guard)
        command.selected = (0, 0, z is not None, 0, 0, 0)
        command.wrench = (0.0, 0.0, 0.0 if z is None else z, 0.0, 0.0, 0.0)
        command.speed, command.guard = (speed,) * 6, guard
        self.rack.write("trajectory.compliance", command)
        return int(command.id)

    def run(self, seconds: float) -> None:
        arm = self.rack.tasks["arm"]
        for _ in range(round(seconds * 1e9 / CLOCK_NS)):
            self.rack.step()
            self.forces.append(arm.written["wrench"].wrench.copy())
            self.targets.append(arm.written["status"].target.copy())

    @property
    def tool(self) -> Array:
        """Position of the tool, (3,), m."""
        return self.ik.compute_tool_pose(self.output("arm", "status").position).position

    def output(self, board: str, port: str) -> Message:
        return cast(Message, self.rack.tasks[board].written[port])

    @property
    def force(self) -> Message:
        return self.output("hybrid", "force")

    @property
    def status(self) -> Message:
        """Status of hybrid control for the trajectory level."""
        return self.output("hybrid", "status")

    @property
    def motion(self) -> Message:
        """Status of the trajectory level."""
        return self.output("trajectory", "status")

    def steps(self) -> tuple[float, float]:
        """Return the greatest velocity and acceleration of the targets so far, as parts of the
        limits."""
        speeds = np.diff(self.targets, axis=0) * 1e9 / CLOCK_NS
        bends = np.diff(speeds, axis=0) * 1e9 / CLOCK_NS
        limits = self.cell.limits
        return float(np.abs(speeds / limits.velocity).max()), float(
            np.abs(bends / limits.acceleration).max()
        )
