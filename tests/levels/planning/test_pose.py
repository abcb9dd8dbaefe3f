"""Poses: composition, interpolation and orientations from directions."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from rack.levels.planning.pose import Pose, pointing, pose


def random_pose(rng: np.random.Generator) -> Pose:
    return pose(rng.normal(size=3), rng.normal(size=4))


def rotated(vector: list[float], quaternion: np.ndarray) -> np.ndarray:
    result = np.zeros(3)
    mujoco.mju_rotVecQuat(result, np.array(vector), quaternion)
    return result


def test_a_pose_times_its_inverse_is_the_identity() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        a, b = random_pose(rng), random_pose(rng)
        assert (a @ (a.inverse() @ b)).is_near(b)


def test_interpolation_between_poses_is_straight_with_a_constant_turn_rate() -> None:
    rng = np.random.default_rng(2)
    a, b = random_pose(rng), random_pose(rng)
    whole = a.angle_to(b)
    for part in (0.0, 0.25, 0.5, 1.0):
        between = a.towards(b, part)
        assert between.position == pytest.approx((1 - part) * a.position + part * b.position)
        assert a.angle_to(between) == pytest.approx(part * whole, abs=1e-9)
        assert between.angle_to(b) == pytest.approx((1 - part) * whole, abs=1e-9)


@pytest.mark.parametrize("direction", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.3, -2.0, 0.4)])
@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_pointing_turns_the_z_axis_to_the_direction(direction: tuple, yaw: float) -> None:
    assert rotated([0, 0, 1], pointing(direction, yaw)) == pytest.approx(
        direction / np.linalg.norm(direction)
    )


def test_yaw_about_a_direction_turns_the_tool_about_its_own_z_axis() -> None:
    still, turned = pose((0, 0, 0), pointing((0, 1, 1))), pose((0, 0, 0), pointing((0, 1, 1), 0.7))
    assert still.angle_to(turned) == pytest.approx(0.7)
