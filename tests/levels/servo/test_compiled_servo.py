"""The compiled functions of the servo level equal their numpy versions bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.lib.recfunctions import structured_to_unstructured

from rack.levels.algebra import Array
from rack.levels.compiled import compiled
from rack.levels.servo import ServoExecutor, actuator_monitor, control, curves, sensor_monitor
from rack.levels.systems.joint_boards import ArmExecutor, JointServo, joint_control
from tests.levels.arms import config
from tests.levels.servo.joint_rig import APART, JointRig
from tests.levels.servo.rig import Course, ServoRig

JOINTS = 7
MODULES = (curves, sensor_monitor, actuator_monitor, control, joint_control)
FUNCTIONS = {
    name: found for m in MODULES for name, found in vars(m).items() if isinstance(found, compiled)
}


def noise(seed: int, *shape: int) -> Array:
    return np.random.default_rng(seed).normal(size=shape or (JOINTS,))


def plain(value: Any) -> Any:
    """Return a structured array as one of numbers, so that NaN equals NaN."""
    array = np.asarray(value)
    return array if array.dtype.names is None else structured_to_unstructured(array)


def sample_of(seed: int, error: float) -> tuple[Any, ...]:
    """Return arguments of `check`: a sample off by `error`, rad; one joint shows no change."""
    estimate, passed_s = np.abs(noise(seed, 3, JOINTS)), 0.0025
    sample = estimate[:2] + 1e-3 * noise(seed + 1, 2, JOINTS)
    sample[1, seed % JOINTS] = estimate[1, seed % JOINTS]
    sample[0] = estimate[0] + 0.5 * passed_s * (sample[1] + estimate[1]) + error * noise(seed + 2)
    estimate[2] *= seed % 3 == 0
    joints = np.zeros(JOINTS, sensor_monitor.MONITORED)
    for name in joints.dtype.names or ():
        joints[name] = 1.0
    for name in ("tolerance", "velocity_tolerance", "unshown"):
        joints[name] = 1e-4
    joints["last_position"], joints["last_velocity"] = estimate[:2]
    joints["last_position"][seed % JOINTS] = sample[0, seed % JOINTS]
    scale = np.array([[9.0], [1e-3], [1e-5]])
    still = np.abs(noise(seed + 3, 3, JOINTS)) * scale
    joints["still_cycles"], joints["still_way"], joints["claimed"] = still
    unusual = (0.01, 5.0) if seed % 11 == 0 else (0.0, 0.0)
    state = joints, estimate, seed % 2 == 0, *sample, noise(seed + 4, 2, JOINTS), passed_s
    return *state, *unusual, seed % 5 > 0, seed % 7 == 0


def motion_of(seed: int, following: float, rules: float) -> tuple[Any, ...]:
    """Return the arguments of `compute_residuals`."""
    inertia = noise(seed + 1, 2, JOINTS, JOINTS)
    motors = np.zeros(JOINTS, actuator_monitor.MOTORS)
    motors["velocity"], motors["bias"], motors["torque"] = noise(seed, 3, JOINTS)
    constants = ("dry", "friction_s", "exact_noise", "uncertain", "off")
    for name, row in zip(constants, np.abs(noise(seed + 2, 5, JOINTS)), strict=True):
        motors[name] = rules * row
    reference, state = noise(seed + 3, 3, JOINTS), noise(seed + 5, 2, JOINTS)
    following = float(following)
    return motors, inertia[0], 200.0, following, reference, state, inertia[1], noise(seed)


def wanted_of(seed: int) -> tuple[Any, ...]:
    """Return the arguments of `set_torque`; one seed has a bias that is NaN."""
    inertia, bias = noise(seed, JOINTS, JOINTS), noise(seed + 1) * (np.nan if seed == 9 else 1.0)
    constants = np.outer((3600.0, 120.0, abs(noise(seed + 2)[0]), 0.0), np.ones(JOINTS))
    return constants, noise(seed + 3, 3, JOINTS), noise(seed + 4, 2, JOINTS), inertia, bias


def joints_of(seed: int) -> tuple[Any, ...]:
    """Return arguments of `servo_joints`: torques cut, NaN, or neither; joints of other boards."""
    limit, driven = (1.0, 1e5)[seed % 2], np.arange(JOINTS) % 2 == 0
    constants = np.outer((3600.0, 120.0, abs(noise(seed)[0]), limit, 0.0), np.ones(JOINTS))
    constants[4] = driven
    loads = np.abs(noise(seed + 1, 4, JOINTS)) * (np.nan if seed == 3 else 1.0)
    motion = noise(seed + 2, 2 * JOINTS), noise(seed + 3, 3, JOINTS)
    rows = noise(seed + 4, 3 * JOINTS), noise(seed + 5, 4 * JOINTS)
    return constants, loads, 0.4, 0.001, 0.002, *motion, *rows


CASES: dict[str, list[tuple[Any, ...]]] = {
    "set_motion": [
        (noise(1, curves.REST + 1, JOINTS), 0.02, ends_s, 0.013, 0.00125, noise(2, 3, JOINTS))
        for ends_s in (0.01, 0.0135, np.inf)
    ],
    "check": [sample_of(seed, error) for seed in range(35) for error in (1e-6, 1e-2, np.nan)],
    "compute_residuals": [
        motion_of(k, following, size)
        for k in range(20)
        for following, size in ((0.02, 1), (9, 1), (9, 1e6))
    ],
    "set_torque": [wanted_of(k) for k in range(10)],
    "limit_torques": [
        (noise(k) * scale, np.full(JOINTS, 1.0)) for k in range(5) for scale in (1e-3, 3.0, np.nan)
    ],
    "servo_joints": [joints_of(k) for k in range(4)],
}
VERDICTS = {"check": 3, "compute_residuals": 3, "limit_torques": 2}
"""Kinds of verdicts that the cases reach; else: None."""


def test_every_compiled_function_has_its_cases() -> None:
    assert set(CASES) == set(FUNCTIONS)


@pytest.mark.parametrize("name", CASES)
def test_compiled_code_gives_the_bits_of_numpy(name: str) -> None:
    verdicts = set()
    for case in CASES[name]:
        under_numpy, compiled_ = (
            [np.array(a, copy=True) if np.ndim(a) else a for a in case] for _ in range(2)
        )
        verdict = FUNCTIONS[name](*under_numpy)
        verdicts.add(verdict)
        assert FUNCTIONS[name].load_machine_code()(*compiled_) == verdict
        for expected, found in zip(under_numpy, compiled_, strict=True):
            np.testing.assert_array_equal(plain(found), plain(expected))
    assert len(verdicts) == VERDICTS.get(name, 1)


def signatures() -> dict[str, list[Any]]:
    """Return the types that the functions are compiled for."""
    return {name: list(f.load_machine_code().signatures) for name, f in FUNCTIONS.items()}  # type: ignore[attr-defined]


def test_no_cycle_waits_for_a_compiler() -> None:
    for level in (ServoExecutor, ArmExecutor, JointServo):
        level.preload()
    loaded = signatures()
    rig = ServoRig(*config("puma560"))
    home = np.array(config("puma560")[0].home)
    move = Course(home, home + 0.2, 1.0)
    rig.run(100, move.at)
    rig.inject("sensor-bias", joint=1, size=0.02)
    rig.run(20, move.at)
    rig.heal()
    rig.run(100, move.at)
    rig.miss(10)
    rig.run(50, move.at)
    rig.restart()
    rig.run(50)
    apart = JointRig(APART)
    apart.run(100)
    apart.rack.lose("servo_j2", ticks=10)
    apart.run(60)
    assert signatures() == loaded
