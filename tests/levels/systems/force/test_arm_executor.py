"""An arm with a wrist sensor that presses against a wall: measurement and stops."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from rack.backplane.message import Message, State
from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import norm
from rack.levels.messages import Error
from rack.levels.planning.ik import InverseKinematics
from rack.levels.planning.pose import make_pose
from rack.levels.robot.cell import build_cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.systems.force.arm_executor import ForceArmExecutor
from rack.levels.systems.joint_boards import JointServo
from rack.levels.systems.joint_boards.messages import JointReference
from tests.levels.lockstep import BoardSpec, Lockstep
from tests.levels.servo.rig import BRAKES, ArmRig
from tests.levels.systems.force.pad import pad

CLOCK_NS = 1_000_000
PERIOD = 20
"""Ticks between references."""
FORWARD = (0.7071067811865476, 0.0, 0.7071067811865476, 0.0)
"""Orientation of a tool that points along the world's x axis."""
FREE_M, WALL_M = 0.74, 0.76
"""x of the tool in front of the wall, and with the pad touching it."""


class PressRig(ArmRig):
    """An arm board and one that servoes its joints, under references for the tool, to and fro."""

    board = "arm"

    def __init__(self, folder: Path, reach: float = 150, resolution: float = 0, **arm: Any) -> None:
        robot, scene = pad(folder, reach=reach, resolution=resolution)
        boards = [
            BoardSpec("arm", 1, ForceArmExecutor, above="servo", params=arm),
            BoardSpec("servo", 1, JointServo, above="level", below="arm"),
        ]
        ik = InverseKinematics(build_cell(robot, scene, CLOCK_NS), 1)
        pose = make_pose((FREE_M, 0.0, 0.75), FORWARD)
        self._near = ik.find_solutions(pose, np.array(robot.home))[0]
        robot = robot.model_copy(update={"home": tuple(self._near)})
        cell = build_cell(robot, scene, CLOCK_NS)
        outside = {"level.command": JointReference}
        super().__init__(Lockstep(boards, robot, scene, outside=outside, clock_ns=CLOCK_NS))
        self._ik, self._dynamics, self.x = ik, Dynamics(cell), FREE_M
        self.command = self.rack.message("level.command")
        self.forces: list[float] = []
        self.braked: list[bool] = []

    @property
    def arm(self) -> ForceArmExecutor:
        return cast(ForceArmExecutor, self.level)

    @property
    def wrench(self) -> Message:
        return cast(Message, self.rack.tasks["arm"].written["wrench"])

    def go(self, x: float, seconds: float) -> None:
        """Move the tool to `x`, m, along the world's x axis, at a constant velocity."""
        cycles = round(seconds / (PERIOD * 1e-3))
        for to in np.linspace(self.x, x, cycles + 1)[1:]:
            speed, before = (x - self.x) / seconds, self._near
            self._near = self._ik.find_nearby(make_pose((to, 0.0, 0.75), FORWARD), before)
            assert self._near is not None
            is_still = to == x or speed == 0.0
            velocity = np.zeros(6) if is_still else (self._near - before) / (PERIOD * 1e-3)
            terms = self._dynamics.terms(self._near, velocity)
            command, self.command.due = self.command, self.rack.tick + 2 * PERIOD
            command.id += 1
            command.position, command.velocity = self._near, velocity
            command.inertia, command.load = np.diagonal(terms.inertia), terms.bias
            self.rack.write("level.command", command)
            self.run(PERIOD)
        self.x = x

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            self.step()
            self.forces.append(norm(self.wrench.wrench[:3]))
            self.braked.append(bool(self.status.braked))


def pressed(folder: Path, depth: float, seconds: float = 0.4, **arm: Any) -> PressRig:
    """Return a rig whose tool has been moved `depth`, m, beyond the wall's surface."""
    rig = PressRig(folder, **arm)
    rig.go(FREE_M, 0.1)
    rig.go(WALL_M + depth, seconds)
    rig.go(rig.x, 0.2)
    return rig


def test_a_contact_within_the_limits_is_measured_and_is_not_a_fault(tmp_path: Path) -> None:
    rig = pressed(tmp_path, 0.002)
    force = rig.wrench.wrench[:3]
    assert -60.0 < force[0] < -10.0
    assert np.abs(force[1:]).max() < 0.4 * abs(force[0])  # friction
    assert (rig.alarms(*BRAKES), rig.status.reason, any(rig.braked[100:])) == ([], "", False)
    assert (rig.wrench.exceeded, rig.wrench.saturated, rig.status.touches) == (0, 0, 0)


@pytest.mark.parametrize(("resolution", "most"), [(0.0, 0.1), (2e-4, 2.0)])
def test_free_motion_is_no_contact(tmp_path: Path, resolution: float, most: float) -> None:
    rig = PressRig(tmp_path, resolution=resolution)
    rig.go(FREE_M, 0.1)
    rig.go(FREE_M - 0.10, 0.2)
    assert max(rig.forces) < most
    # A sensor at the end of its range is a finding.
    rig.arm.arm.sense_wrist = lambda: np.array([150.0, 0, 0, 0, 0, 0])  # type: ignore[method-assign]
    rig.run(1)
    assert rig.wrench.saturated
    assert rig.alarms(*BRAKES) == [Alarm.FORCE_LIMIT]


@pytest.mark.slow
@pytest.mark.parametrize(("reaction", "is_braked"), [("brake", 1), ("stop", 1), ("hold", 0)])
def test_too_strong_a_contact_stops_the_arm(tmp_path: Path, reaction: str, is_braked: bool) -> None:
    rig = pressed(tmp_path, 0.01, seconds=1.0, retry=2.0, on_force_limit=reaction)
    assert rig.alarms(*BRAKES) == [Alarm.FORCE_LIMIT]
    found = next(found for found in rig.found if found.finding.alarm is Alarm.FORCE_LIMIT)
    assert 60.0 < found.finding.value == rig.forces[found.tick] < 80.0
    assert max(rig.forces[: found.tick]) < 60.0
    assert rig.wrench.exceeded > 0
    assert rig.braked[-1] == is_braked
    assert rig.status.stopped
    assert rig.status.reason.startswith("contact too strong: force of ")
    assert "permitted: 60; latched at tick" in rig.status.reason
    assert (rig.status.state, rig.status.violations) == (State.HOLDING, 0)


def test_the_arm_follows_again_when_the_contact_is_over(tmp_path: Path) -> None:
    rig = pressed(tmp_path, 0.02, retry=0.05)
    for _ in range(20):
        rig.go(FREE_M, 0.2)
        if not rig.status.reason:
            break
    assert (rig.status.reason, rig.status.error) == ("", Error.NONE)
    latched = pressed(tmp_path, 0.02, patience=0.15)
    assert Alarm.LATCHED in latched.alarms(*BRAKES)
    assert (latched.status.state, latched.status.error) == (State.ERROR, Error.FORCE)
    assert latched.status.reason.endswith("not over within 0.15 s")
