"""Hybrid control under a trajectory level: a tool that presses on a table and slides."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from rack.backplane.message import Message, State
from rack.levels.algebra import Array
from rack.levels.level import Demand
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
from tests.levels.box import hold_back, mute
from tests.levels.lockstep import BoardSpec, Lockstep
from tests.levels.systems.force.pad import pad

pytestmark = pytest.mark.slow

CLOCK_NS = 1_000_000
DOWN = (0.0, 1.0, 0.0, 0.0)
"""Orientation of a tool that points straight down."""
TABLE_M = 0.45
"""Height of the table, where the tool touches it."""
START = (0.55, 0.0, TABLE_M + 0.02)
FREE = (0.0,) * 6


class HybridRig:
    """Runs the levels tick by tick; the test queues motions and writes the wanted contact."""

    def __init__(self, folder: Path, start: Sequence[float] = START, **gains: float) -> None:
        robot, scene = pad(folder)
        ik = InverseKinematics(build_cell(robot, scene, CLOCK_NS), 1)
        near, pose = np.array(robot.home), make_pose(start, DOWN)
        (home, *_) = ik.find_solutions(pose, near)
        robot = robot.model_copy(update={"home": tuple(home)})
        self.cell, self.ik = build_cell(robot, scene, CLOCK_NS), ik
        places = {"above": "trajectory", "below": "servo"}
        boards = [
            BoardSpec("arm", 1, ForceArmExecutor, above="servo"),
            BoardSpec("servo", 1, JointServo, above="hybrid", below="arm"),
            BoardSpec("hybrid", 5, HybridExecutor, **places, params=gains),
            BoardSpec("trajectory", 20, TrajectoryExecutor, above="client", below="hybrid"),
        ]
        outside = {
            "client.requests": MotionRequest,
            "trajectory.compliance": Compliance,
            "world.model": WorldState,
        }
        self.rack = Lockstep(boards, robot, scene, outside=outside, clock_ns=CLOCK_NS)
        self.rack.show("world.model", revision=1)
        self.compliance = self.rack.message("trajectory.compliance")
        self.compliance.frame = (1.0, 0.0, 0.0, 0.0)
        self._request = self.rack.message("client.requests")
        self.forces: list[Array] = []  # (6,), of the contact on the tool
        self.targets: list[Array] = []  # (joints,), of the arm

    def line(self, position: Sequence[float], segment: float = 0.0) -> int:
        """Queue a line of the tool; return its id."""
        request = self._request
        request.id, request.kind, request.body = request.id + 1, MotionKind.POSE, -1
        request.segment = segment
        request.position, request.quaternion = position, DOWN
        self.rack.write("client.requests", request)
        return int(request.id)

    def comply(self, z: float | None, speed: float = 0.03, guard: Sequence[float] = FREE) -> int:
        """Press with a force, N, along z; None: z is an axis of motion. Return the command's id."""
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
        """Return the greatest velocity and acceleration of the targets, as parts of the limits."""
        speeds = np.diff(self.targets, axis=0) * 1e9 / CLOCK_NS
        bends = np.diff(speeds, axis=0) * 1e9 / CLOCK_NS
        limits = self.cell.limits
        fastest, hardest = np.abs(speeds / limits.velocity), np.abs(bends / limits.acceleration)
        return float(fastest.max()), float(hardest.max())


WANTED_N = 20.0


def pressing(folder: Path, **gains: float) -> HybridRig:
    """Return a rig whose tool has come down and presses on the table."""
    rig = HybridRig(folder, start=(START[0], START[1], START[2] - 0.015), **gains)
    rig.run(0.2)
    rig.comply(-WANTED_N)
    rig.run(1.2)
    return rig


def pressed(rig: HybridRig, seconds: float) -> np.ndarray:
    """Return the forces on the tool along z in the last `seconds`, N."""
    return np.array(rig.forces)[-round(seconds * 1e3) :, 2]


def test_a_force_settles_is_kept_along_a_motion_and_ends_without_a_step(tmp_path: Path) -> None:
    rig = pressing(tmp_path)
    assert np.abs(pressed(rig, 0.2) - WANTED_N).max() < 0.5
    assert pressed(rig, 1.2).max() < 1.1 * WANTED_N
    assert rig.force.wanted[2] == -WANTED_N
    assert rig.force.wrench[2] == pytest.approx(WANTED_N, abs=0.5)
    assert rig.force.offset[2] < -0.005
    assert (rig.force.state, rig.force.reason) == (State.EXECUTING, "")
    rig.line((START[0], START[1] + 0.08, START[2] - 0.015), segment=0.8)
    rig.run(1.6)
    assert np.abs(pressed(rig, 1.6) - WANTED_N).max() < 3.0
    assert np.abs(rig.tool[:2] - (START[0], START[1] + 0.08)).max() < 1e-3
    assert rig.motion.reason == ""
    rig.line((START[0], START[1], START[2] - 0.015), segment=0.8)
    rig.run(0.6)
    rig.comply(None)
    rig.run(1.0)
    assert max(rig.steps()) < 1.2
    assert np.abs(pressed(rig, 0.2)).max() < WANTED_N + 5.0
    assert abs(rig.tool[1] - START[1]) < 1e-3
    away = rig.status.target - rig.output("trajectory", "command").position
    assert 1e-3 < np.abs(away).max() < 0.1


@pytest.mark.parametrize("axis", [1, pytest.param(2, marks=pytest.mark.thorough)])
def test_a_struck_guard_ends_the_motion_once(tmp_path: Path, axis: int) -> None:
    guard = np.zeros(6)
    guard[axis] = 8.0
    start = (START[0], START[1], START[2] - 0.015)
    rig = HybridRig(tmp_path, start=start)
    rig.run(0.2)
    if axis == 1:  # sliding: friction is felt along y
        rig.comply(-2.0 * WANTED_N)
        rig.run(1.0)
    command = rig.comply(-2.0 * WANTED_N if axis == 1 else None, guard=guard)
    x, y, z = start
    way = (x, y + 0.1, z) if axis == 1 else (x, y, z - 0.05)
    rig.line(way, segment=2.0)
    rig.run(0.8)
    assert (rig.force.struck, rig.force.axis) == (command, axis)
    assert rig.force.reason == f"guard of axis {'xyz'[axis]} was struck: held until another command"
    assert rig.status.holding
    rest = rig.tool
    rig.run(0.2)
    assert np.abs(rig.tool - rest).max() < 2e-3
    assert max(rig.steps()) < 1.2
    if axis == 1:
        assert abs(rig.forces[-1][2] - 2.0 * WANTED_N) < 4.0
        return
    rig.rack.lose("hybrid", ticks=20)
    rig.run(0.3)
    assert (rig.force.struck, rig.force.axis) == (command, axis), "a restarted board strikes none"
    assert rig.force.reason.startswith("guard of axis z was struck")
    rig.comply(None)
    rig.line((START[0], START[1], START[2] + 0.02), segment=0.5)
    rig.run(1.5)
    assert rig.force.reason == ""


@pytest.mark.thorough
def test_force_axes_rest_while_wrench_or_commands_are_missing(tmp_path: Path) -> None:
    rig = pressing(tmp_path)
    silent = "no wrench from the board of the arm: waiting for it"
    stale = "wrench is stale, 21 ticks: waiting for the board of the arm"
    cases = (mute, silent, 2.0 * WANTED_N), (hold_back(20), stale, WANTED_N)
    for disturbance, reason, wanted in cases:
        rig.rack.disturb("arm.wrench", disturbance, ticks=300)
        rig.run(0.05)
        rig.comply(-wanted)
        rig.run(0.15)
        held = rig.status.target.copy()
        assert rig.force.reason == reason
        assert (rig.force.state, rig.status.state) == (State.HOLDING, State.HOLDING)
        rig.run(0.05)
        assert np.abs(rig.status.target - held).max() < 1e-6
        rig.run(1.5)
        assert np.abs(pressed(rig, 0.1) - wanted).max() < 2.0
    rig.rack.boxes["trajectory.compliance"].lost = True
    rig.comply(-2.0 * WANTED_N)
    rig.run(0.3)
    assert rig.force.reason == "no command from the level above: held until its board is back"
    assert np.abs(pressed(rig, 0.1) - WANTED_N).max() < 5.0


@pytest.mark.parametrize(("field", "value"), [("frame", (0.0,) * 4), ("wrench", (np.nan,) * 6)])
def test_a_bad_command_is_refused(tmp_path: Path, field: str, value: Sequence[float]) -> None:
    rig = HybridRig(tmp_path)
    rig.run(0.1)
    setattr(rig.compliance, field, value)
    rig.compliance.id, rig.compliance.active, rig.compliance.selected[2] = 1, 1, 1
    rig.rack.write("trajectory.compliance", rig.compliance)
    rig.run(0.1)
    assert rig.force.reason.startswith("compliance 1 rejected: ")
    assert np.abs(rig.status.target - rig.cell.home).max() < 1e-6
    # One beyond the arm's limit is cut.
    rig.compliance.frame = (1.0, 0.0, 0.0, 0.0)
    rig.comply(-90.0, speed=0.001)
    rig.run(0.1)
    assert rig.force.wanted[2] == -60.0
    assert rig.force.reason == "force of 90 N is wanted, 60 applied: the arm's limit on contacts"
    assert not rig.status.holding


@pytest.mark.thorough
def test_after_restart_and_brakes_motion_begins_where_the_arm_is(tmp_path: Path) -> None:
    rig = pressing(tmp_path)
    rig.rack.lose("hybrid", ticks=100)
    rig.run(1.2)
    assert np.abs(pressed(rig, 1.2) - WANTED_N).max() < 10.0
    assert np.abs(pressed(rig, 0.1) - WANTED_N).max() < 1.0
    assert max(rig.steps()) < 1.2
    rig.rack.stop(Demand.BRAKE, ticks=200)
    rig.run(0.1)
    assert rig.status.stopped
    assert rig.status.reason.startswith("waiting for servo: ")
    rig.run(1.5)
    assert not rig.status.stopped
    assert np.abs(pressed(rig, 0.1) - WANTED_N).max() < 1.0
