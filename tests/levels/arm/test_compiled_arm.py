"""The compiled functions of the arm: the bits of their Python, and one version for all robots."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rack.backplane.message import Message
from rack.levels import arm as arm_package
from rack.levels.arm import SimulatedArm, drives, sensors, substeps
from rack.levels.compiled import compiled
from rack.levels.messages import Scene
from rack.levels.robot import dynamics
from rack.levels.robot.cell import Cell, build_cell, compute_sizes
from rack.levels.robot.dynamics import Dynamics, Payload
from rack.levels.robot.limits import Encoders
from tests.levels.arms import CLOCK_NS, cell, config, save_state
from tests.levels.robot.grippers import four_bar

RNG = np.random.default_rng(8)
OFFSET = np.array([0.02, -0.03, 0.05])


def drive_cycles(arm: SimulatedArm, made: Cell, ticks: int) -> Message:
    """Drive an arm as a controller does; return its state."""
    for tick in range(ticks):
        sensed = arm.sense()
        bias = arm.dynamics.terms(sensed.position, sensed.velocity).bias
        arm.drive(bias + 0.3 * made.bounds.torque * np.sin(0.1 * tick + np.arange(len(bias))), 10.0)
        arm.step(1)
    return save_state(arm)


def scene(arm: SimulatedArm, made: Cell) -> Message:
    seen = Scene.zeros(compute_sizes(made))
    arm.look(seen)
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("name", ["puma560", "k1607", "puma560_crossing"])
def test_an_arm_moves_bit_for_bit_as_in_python(name: str) -> None:
    made = cell(name)
    one, other = (SimulatedArm(made, config(name)[1], CLOCK_NS) for _ in range(2))
    other._advance, other._copy_state = substeps.make_steps, substeps.copy_state
    other._gate._is_clear = drives.is_clear
    other.dynamics._evaluate = dynamics.evaluate_terms
    other.dynamics._carry = dynamics.add_payload
    assert drive_cycles(one, made, 300).raw == drive_cycles(other, made, 300).raw
    assert one.touches == other.touches
    assert scene(one, made).raw == scene(other, made).raw


@pytest.mark.parametrize("name", ["puma560", "k1607"])
def test_the_equation_of_motion_is_the_same_as_in_python(name: str) -> None:
    made = cell(name)
    one, other = Dynamics(made), Dynamics(made)
    other._evaluate, other._carry = dynamics.evaluate_terms, dynamics.add_payload
    for q, qd in RNG.uniform(-1.0, 1.0, (20, 2, len(made.qpos))):
        for payload in (None, Payload(1.5, OFFSET)):
            pairs = zip(one.terms(q, qd, payload), other.terms(q, qd, payload), strict=True)
            for mine, theirs in pairs:
                assert np.array_equal(mine, theirs)


def test_solutions_and_coarse_samples_are_the_same_as_in_python() -> None:
    square = RNG.normal(size=(6, 6))
    inertia, load = square.T @ square + np.eye(6), RNG.normal(size=6)
    solution = drives.cholesky_solve.load_machine_code()(inertia, load)
    assert np.array_equal(solution, drives.cholesky_solve(inertia, load))
    assert solution == pytest.approx(np.linalg.solve(inertia, load))
    rules = np.full((2, 6), 1e-3), np.array([[1e-4] * 6, [0.0] * 6])
    for tick in range(50):
        one, other = np.ones((2, 6)), np.ones((2, 6))
        sensors.sense_coarsely.load_machine_code()(one, tick, 7, *rules)
        sensors.sense_coarsely(other, tick, 7, *rules)
        assert np.array_equal(one, other)


def test_preloading_leaves_nothing_to_be_compiled_in_a_cycle(tmp_path: Path) -> None:
    arm_package.preload()
    four = four_bar(tmp_path)
    puma = cell("puma560"), config("puma560")[1]
    for made, surroundings in (puma, (build_cell(*four, CLOCK_NS), four[1])):
        arm = SimulatedArm(made, surroundings, CLOCK_NS)
        arm.dynamics.terms(made.home, np.zeros(6), Payload(1.0, OFFSET))
        drive_cycles(arm, made, 3)
        arm.drive(made.bounds.torque, 0.0)
        arm.brake()
        arm.step(2)
        scene(arm, made)
    encoders = Encoders(np.zeros(6), np.full(6, 1e-3))
    sensors.CoarseSensors(encoders, 5).sample(np.zeros(6), np.zeros(6), 1)
    functions: list[compiled[..., Any]] = [
        *(dynamics.evaluate_terms, dynamics.add_payload, substeps.make_steps, substeps.copy_state),
        *(drives.is_clear, sensors.sense_coarsely),
    ]
    machines: list[Callable[..., Any]] = [function.load_machine_code() for function in functions]
    assert [len(machine.signatures) for machine in machines] == [1] * len(machines)  # type: ignore[attr-defined]
