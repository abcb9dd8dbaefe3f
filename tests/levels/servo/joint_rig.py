"""A board of an arm and boards that servo its joints, under a level that swings them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from rack.backplane.message import Message
from rack.boards.faults import KINDS
from rack.levels.algebra import Array
from rack.levels.level import Fault
from rack.levels.systems.joint_boards import ArmExecutor, JointServo
from tests.boards.joint_levels import Swing
from tests.levels.arms import config
from tests.levels.lockstep import BoardSpec, Lockstep
from tests.levels.servo.rig import Found

CLOCK_NS = 1_000_000
SWING_TICKS = 20
JOINTS = config("puma560")[0].joints
TOGETHER: Mapping[str, Mapping[str, Any]] = {"servo": {"gripper": True}}
APART = {f"servo_{joint}": {"joints": [joint], "gripper": joint == JOINTS[-1]} for joint in JOINTS}
"""Parameters of the boards that servo joints, by name: one board for all or one for each."""


class JointRig:
    """Runs the levels tick by tick, and keeps what the arm reports."""

    def __init__(
        self,
        servos: Mapping[str, Mapping[str, Any]] = TOGETHER,
        every: int = 1,
        servo: type[JointServo] = JointServo,
        **arm: float | str,
    ) -> None:
        """Start boards `servos`, by name with their parameters, every `every` ticks; `arm` are the
        arm's parameters."""
        robot, scene = config("puma560")
        names = tuple(servos)
        boards = [
            BoardSpec("arm", 1, ArmExecutor, above=names, params=arm),
            *(
                BoardSpec(n, every, servo, above="swing", below="arm", params=p)
                for n, p in servos.items()
            ),
            BoardSpec("swing", SWING_TICKS, Swing, below=names),
        ]
        self.rack = Lockstep(
            boards, robot.model_copy(update={"substeps": 2}), scene, clock_ns=CLOCK_NS
        )
        self.names = names
        self.positions: list[Array] = []
        self.targets: list[Array] = []
        self.braked: list[bool] = []
        self.found: list[Found] = []
        self._faults: list[Fault] = []

    @property
    def arm(self) -> ArmExecutor:
        """Present executor of the arm, which a restart replaces."""
        return cast(ArmExecutor, self.rack.tasks["arm"].level)

    @property
    def swing(self) -> Swing:
        """Present level above the boards that servo joints."""
        return cast(Swing, self.rack.tasks["swing"].level)

    @property
    def status(self) -> Message:
        """Last status of the board of the arm."""
        return cast(Message, self.rack.tasks["arm"].written["status"])

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            arm = self.arm
            self.rack.step()
            self.found += [Found(self.rack.tick - 1, finding) for finding in arm.findings]
            arm.findings.clear()
            arm.acted.clear()
            self.positions.append(self.status.position.copy())
            self.targets.append(self.status.target.copy())
            self.braked.append(bool(self.status.braked))

    def inject(self, kind: str, **parameters: float) -> None:
        """Begin another fault of the arm in the next tick."""
        self._faults.append(Fault(kind, parameters, 5, self.rack.tick, KINDS[kind].step))
        self.arm.inject(self._faults)

    def heal(self) -> None:
        """End all faults from the next tick on."""
        self._faults = []
        self.arm.inject([])

    def errors(self) -> Array:
        """Return the tracking error of the arm at each tick, (ticks, joints), rad."""
        return np.array(self.positions) - np.array(self.targets)
