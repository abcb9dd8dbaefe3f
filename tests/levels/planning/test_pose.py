"""Poses: composition, interpolation and orientations from directions."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from rack.levels.planning.pose import Pose, build_pointing_quaternion, make_pose


def random_pose(rng: np.random.Generator) -> Pose:
    return make_pose(rng.normal(size=3), rng.normal(size=4))


def test_a_pose_times_its_inverse_is_the_identity() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        a, b = random_pose(rng), random_pose(rng)
        assert (a @ (a.inverse() @ b)).is_near(b)


def test_interpolation_between_poses_is_straight_with_a_constant_turn_rate() -> None:
    rng = np.random.default_rng(2)
    a, b = random_pose(rng), random_pose(rng)
    whole = a.compute_angle(b)
    for part in (0.0, 0.25, 0.5, 1.0):
        between = a.interpolate_to(b, part)
        assert between.position == pytest.approx((1 - part) * a.position + part * b.position)
        assert a.compute_angle(between) == pytest.approx(part * whole, abs=1e-9)
        assert between.compute_angle(b) == pytest.approx((1 - part) * whole, abs=1e-9)


@pytest.mark.parametrize("direction", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.3, -2.0, 0.4)])
@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_pointing_turns_the_z_axis_to_the_direction(direction: tuple, yaw: float) -> None:
    pointed = np.zeros(3)
    up = np.array([0.0, 0.0, 1.0])
    mujoco.mju_rotVecQuat(pointed, up, build_pointing_quaternion(direction, yaw))
    assert pointed == pytest.approx(direction / np.linalg.norm(direction))


def test_yaw_about_a_direction_turns_the_tool_about_its_own_z_axis() -> None:
    quaternions = (build_pointing_quaternion((0, 1, 1), yaw) for yaw in (0.0, 0.7))
    still, turned = (make_pose((0, 0, 0), quaternion) for quaternion in quaternions)
    assert still.compute_angle(turned) == pytest.approx(0.7)
