"""Paths around the wall of the PUMA's cell."""

from __future__ import annotations

import gc

import numpy as np
import pytest

from rack.levels.messages import WAYPOINTS
from rack.levels.motion.path import BlendedPath, Path
from rack.levels.planning import path_planner
from rack.levels.planning.collision import CollisionChecker
from rack.levels.planning.ik import InverseKinematics
from rack.levels.planning.path_planner import PathPlanner
from rack.levels.planning.pose import build_pointing_quaternion, make_pose
from rack.levels.robot.cell import Cell
from tests.levels.arms import cell, config

SEED = 3
SCENE = config("puma560")[1]
DOWN = build_pointing_quaternion((0, 0, -1))
Sides = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def puma() -> Cell:
    return cell("puma560")


@pytest.fixture(scope="module")
def checker(puma: Cell) -> CollisionChecker:
    return CollisionChecker(puma, SCENE)


@pytest.fixture(scope="module")
def planner(puma: Cell) -> PathPlanner:
    return PathPlanner(puma, SCENE.clearance, SEED)


@pytest.fixture(scope="module")
def sides(puma: Cell, checker: CollisionChecker) -> Sides:
    """Configurations low on either side of the wall."""
    ik = InverseKinematics(puma, SEED)
    poses = (make_pose((0.5, y, 0.6), DOWN) for y in (0.3, -0.2))
    left = next(filter(checker.is_free, ik.find_solutions(next(poses), puma.home)))
    return left, next(filter(checker.is_free, ik.find_solutions(next(poses), left)))


@pytest.fixture(scope="module")
def around(planner: PathPlanner, checker: CollisionChecker, sides: Sides) -> Path:
    path = planner.plan(*sides, checker.find_first_blocked)
    assert path is not None
    return path


@pytest.mark.slow
def test_path_around_the_wall_is_free_between_its_checks_too(
    planner: PathPlanner, checker: CollisionChecker, around: Path, sides: Sides
) -> None:
    assert np.array_equal(around.waypoints[0], sides[0])
    assert np.array_equal(around.end, sides[1])
    assert 3 <= len(around.waypoints) <= WAYPOINTS
    # Between two checks no point moves farther than half the clearance: half of that may be lost.
    least = 0.74 * SCENE.clearance
    points = BlendedPath(*around).sample_points(0.13 * planner.step_rad)
    assert all(checker.is_free(q, least) for q in points)


@pytest.mark.slow
def test_equal_requests_get_equal_paths_whatever_was_planned_before(
    puma: Cell, checker: CollisionChecker, around: Path, sides: Sides
) -> None:
    fresh, blocked = PathPlanner(puma, SCENE.clearance, SEED), checker.find_first_blocked
    fresh.plan(sides[1], sides[0], blocked)
    again = fresh.plan(*sides, blocked)
    assert again is not None
    assert np.array_equal(again.waypoints, around.waypoints)
    assert np.array_equal(again.blend, around.blend)
    other = fresh.plan(*sides, blocked, attempt=1)
    assert other is not None
    assert not np.array_equal(other.waypoints[1], around.waypoints[1])
    hasty = fresh.plan(*sides, blocked, searches=1)
    assert hasty is not None
    assert fresh.compute_duration(hasty) >= fresh.compute_duration(around)


def test_no_path_where_goal_or_start_is_blocked(
    planner: PathPlanner, checker: CollisionChecker, puma: Cell
) -> None:
    pose = make_pose((0.5, 0.0, 0.65), DOWN)
    in_the_wall = InverseKinematics(puma, SEED).find_solutions(pose, puma.home)[0]
    assert planner.plan(puma.home, in_the_wall, checker.find_first_blocked) is None
    assert planner.plan(in_the_wall, puma.home, checker.find_first_blocked) is None


def test_blend_shrinks_to_a_stop_where_its_inside_is_blocked(planner: PathPlanner) -> None:
    corner = np.array([[0.0, 1, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0, 0]])

    def on_the_polyline(configurations: np.ndarray) -> int:
        off = configurations[:, :2].min(axis=1) >= 1e-3
        return int(np.argmax(off)) if off.any() else len(off)

    path = planner.round_corners(corner, on_the_polyline)
    assert path.blend[1] == 0.0
    assert planner.find_blocked_configuration(path, on_the_polyline) is None
    assert planner.round_corners(corner, len).blend[1] > 0.5


def test_a_search_frees_its_memory(
    planner: PathPlanner, sides: Sides, monkeypatch: pytest.MonkeyPatch
) -> None:
    alive = []

    class Counted(path_planner.MotionCheck):  # type: ignore[misc]  # untyped
        def __init__(self, *args: object) -> None:
            super().__init__(*args)
            alive.append(self._free)

        def __del__(self) -> None:
            alive.remove(self._free)

    monkeypatch.setattr(path_planner, "MotionCheck", Counted)
    assert planner._search_once(np.array(sides), len, 1, 100)[1] > 1
    gc.collect()
    assert alive == []
