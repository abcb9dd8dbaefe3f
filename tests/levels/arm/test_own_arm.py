"""An arm of the user's own: a class named in the config takes the place of the simulated one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.backplane.message import Message
from rack.boards.config import load, resolve_layout
from rack.boards.errors import ConfigError
from rack.levels.algebra import Array, solve
from rack.levels.arm import Arm, Sensed
from rack.levels.level import Finding
from rack.levels.planning.ik import InverseKinematics
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.tables import SceneConfig
from tests.levels.arms import pendulum
from tests.levels.servo.rig import Course, ServoRig

START, GOAL = np.array([0.0, 0.5]), np.array([0.6, -0.4])
SUBSTEPS = 10
HERE = f"{__name__}:"


class IdealArm(Arm):
    """Integrates the equation of motion; its brakes stop it at once."""

    def __init__(
        self, cell: Cell, scene: SceneConfig, clock_ns: int, every: int = 1, seed: int = 0
    ) -> None:
        super().__init__(cell, scene, clock_ns, every, seed)
        self._dynamics, self._step_s = Dynamics(cell), clock_ns * 1e-9 / SUBSTEPS
        self._q, self._qd = cell.home.copy(), np.zeros(len(cell.home))

    def sense(self) -> Sensed:
        return Sensed(self._q.copy(), self._qd.copy(), 0.0, 0.0, self.tick)

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        finding = self.refused(torque)
        if finding is not None:
            self.brake()
        else:
            self.torque, self.waited, self.braked = torque.copy(), 0, False
        return finding

    def brake(self) -> None:
        self.braked = True
        self._qd[:] = self.torque[:] = 0.0

    def step(self, ticks: int) -> None:
        for _ in range(ticks):
            if self.waited >= self.patience:
                self.brake()
            for step in range(0 if self.braked else SUBSTEPS):
                torque = self.compute_torque(step)
                inertia, bias = self._dynamics.terms(self._q, self._qd)
                self._qd += self._step_s * solve(inertia, torque - bias)
                self._q += self._step_s * self._qd
            self.waited += 1
            self.tick += 1

    def compute_torque(self, step: int) -> Array:
        """Return the torque of the motors in a substep of a tick, (joints,), N m."""
        return self.torque

    def save(self, state: Message) -> None:
        super().save(state)
        state.state[: 2 * len(self._q)] = [*self._q, *self._qd]

    def restore(self, state: Message) -> None:
        super().restore(state)
        self._q[:], self._qd[:] = state.state[: 2 * len(self._q)].reshape(2, -1)


class HalfAnArm(Arm):
    """Lacks all that an arm must do but one thing."""

    def sense(self) -> Sensed:
        return Sensed(np.zeros(2), np.zeros(2), 0.0, 0.0, self.tick)


@pytest.fixture
def rig(tmp_path: Path) -> ServoRig:
    return ServoRig(pendulum(tmp_path), SceneConfig(), arm=HERE + "IdealArm")


@pytest.mark.slow
def test_an_arm_named_in_the_config_is_driven_and_follows_its_set_points(rig: ServoRig) -> None:
    course = Course(START, GOAL, 0.8)
    rig.run(400, course.at)
    assert isinstance(rig.servo.arm, IdealArm)
    assert np.abs(rig.errors(course.at)).max() < 5e-3
    assert np.abs(rig.status.position - GOAL).max() < 1e-3
    assert not rig.alarms()
    assert (rig.status.touches, rig.status.violations, rig.status.clipped) == (0, 0, 0)
    # The default scene shows the tool where the sensed joints put it.
    scene = rig.rack.read("servo.scene")
    tool = InverseKinematics(rig.servo.arm.cell, 0).compute_tool_pose(rig.positions[-2])
    assert np.abs(scene.tool_position - tool.position).max() < 1e-3


def test_a_restarted_board_restores_the_arm(rig: ServoRig) -> None:
    rig.run(500, Course(START, GOAL, 1.0).at)
    rig.restart()
    rig.run(100, lambda _: (GOAL, np.zeros(2)))
    assert np.abs(np.array(rig.positions[-100:]) - GOAL).max() < 5e-3


@pytest.mark.parametrize(
    ("reference", "why"),
    [
        ("nobody:Arm", "cannot import 'nobody': ModuleNotFoundError: No module named 'nobody'"),
        (HERE + "Missing", f"module '{__name__}' has no class 'Missing'"),
        ("rack.levels.arm:Sensed", "module 'rack.levels.arm' has no Arm named 'Sensed'; it has: "),
        (HERE + "HalfAnArm", "class 'HalfAnArm' does not implement: brake, step"),
    ],
)
def test_a_class_that_is_no_arm_is_refused_before_launch(reference: str, why: str) -> None:
    with pytest.raises(ConfigError) as caught:
        resolve_layout(load("nasrem", [f"board.servo.params.arm={reference!r}"]))
    (mistake,) = caught.value.mistakes
    assert mistake.place == "board.servo.params.arm"
    assert mistake.why.startswith(why)
