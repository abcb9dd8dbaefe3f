"""A board of an arm and boards that servo its joints, under a level that swings them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from rack.levels.algebra import Array
from rack.levels.systems.joint_boards import ArmExecutor, JointServo
from tests.boards.joint_levels import Swing
from tests.levels.arms import config
from tests.levels.lockstep import BoardSpec, Lockstep
from tests.levels.servo.rig import ArmRig

CLOCK_NS = 1_000_000
SWING_TICKS = 20
JOINTS = config("puma560")[0].joints
TOGETHER: Mapping[str, Mapping[str, Any]] = {"servo": {"gripper": True}}
APART = {f"servo_{joint}": {"joints": [joint], "gripper": joint == JOINTS[-1]} for joint in JOINTS}
"""Parameters of the boards that servo joints, by name: one board for all or one for each."""


class JointRig(ArmRig):
    """Runs the levels tick by tick, and keeps what the arm reports."""

    board = "arm"

    def __init__(
        self,
        servos: Mapping[str, Mapping[str, Any]] = TOGETHER,
        servo: type[JointServo] = JointServo,
        **arm: float | str,
    ) -> None:
        """Start boards `servos`, by name with their parameters; `arm` are the arm's parameters."""
        robot, scene = config("puma560")
        names = tuple(servos)
        places = {"above": "swing", "below": "arm"}
        boards = [
            BoardSpec("arm", 1, ArmExecutor, above=names, params=arm),
            *(BoardSpec(n, 1, servo, **places, params=p) for n, p in servos.items()),
            BoardSpec("swing", SWING_TICKS, Swing, below=names),
        ]
        robot = robot.model_copy(update={"substeps": 2})
        super().__init__(Lockstep(boards, robot, scene, clock_ns=CLOCK_NS))
        self.braked: list[bool] = []

    @property
    def arm(self) -> ArmExecutor:
        return cast(ArmExecutor, self.level)

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            self.step()
            self.positions.append(self.status.position.copy())
            self.targets.append(self.status.target.copy())
            self.braked.append(bool(self.status.braked))

    def errors(self) -> Array:
        """Return the tracking error of the arm at each tick, (ticks, joints), rad."""
        return np.array(self.positions) - np.array(self.targets)
