"""Inverse kinematics of the PUMA and of an arm with seven joints, and straight lines."""

from __future__ import annotations

import numpy as np
import pytest

from rack.levels.motion.path import BlendedPath
from rack.levels.planning.ik import LIMIT_MARGIN_RAD, InverseKinematics, find_sampling_range
from rack.levels.planning.motion_planner import MAX_DEVIATION_M, plan_straight_line
from rack.levels.planning.pose import build_pointing_quaternion, make_pose
from tests.levels.arms import cell

SEED = 7
CELLS = {name: cell(name) for name in ("puma560", "k1607")}
SOLVERS = {name: InverseKinematics(c, SEED) for name, c in CELLS.items()}
DOWN = build_pointing_quaternion((0.0, 0.0, -1.0))


@pytest.mark.slow
@pytest.mark.parametrize("name", CELLS)
def test_every_pose_of_a_valid_configuration_is_reached_within_the_limits(name: str) -> None:
    ik, limits = SOLVERS[name], CELLS[name].limits.position
    rng, (low, high) = np.random.default_rng(SEED), find_sampling_range(CELLS[name])
    margin = 2 * LIMIT_MARGIN_RAD
    for _ in range(40):
        target = ik.compute_tool_pose(rng.uniform(low + margin, high - margin))
        found = ik.find_solutions(target, CELLS[name].home)
        assert found
        for q in found:
            reached = ik.compute_tool_pose(q)
            assert reached.position == pytest.approx(target.position, abs=1e-4)
            assert reached.compute_angle(target) < 1e-4
            assert np.all(q >= limits[:, 0])
            assert np.all(q <= limits[:, 1])


def test_solutions_are_distinct_and_the_quickest_to_reach_is_first() -> None:
    ik, home = SOLVERS["puma560"], CELLS["puma560"].home
    pose = make_pose((0.5, -0.2, 0.7), DOWN)
    found = ik.find_solutions(pose, home)
    assert len(found) >= 2
    times = [ik.compute_travel_time(home, q) for q in found]
    assert times == sorted(times)
    for k, q in enumerate(found):
        assert all(np.max(np.abs(q - other)) > 1e-2 for other in found[:k])


def test_a_pose_out_of_reach_has_no_solution_and_no_line() -> None:
    ik, home = SOLVERS["puma560"], CELLS["puma560"].home
    assert ik.find_solutions(make_pose((2.0, 0.0, 0.5), DOWN), home) == []
    away = ik.compute_tool_pose(home).position + np.array([1.0, 0.0, 0.0])
    assert plan_straight_line(ik, home, make_pose(away, DOWN)) is None


@pytest.mark.parametrize("name", CELLS)
@pytest.mark.parametrize("way", [(0.0, 0.0, 0.1), (0.1, 0.08, 0.0), (0.0, -0.25, 0.05)])
def test_tool_follows_a_straight_line(name: str, way: tuple[float, float, float]) -> None:
    ik, start = SOLVERS[name], CELLS[name].home
    begin = ik.compute_tool_pose(start)
    end = make_pose(begin.position + np.array(way), begin.quaternion)
    path = plan_straight_line(ik, start, end)
    assert path is not None
    assert np.array_equal(path.waypoints[0], start)
    assert ik.compute_tool_pose(path.end).position == pytest.approx(end.position, abs=1e-4)
    length = np.linalg.norm(way)
    for q in BlendedPath(*path).sample_points(0.01):
        tool = ik.compute_tool_pose(q)
        off = tool.position - begin.position
        along = off @ np.array(way) / length
        assert np.linalg.norm(off - along * np.array(way) / length) < 1.5 * MAX_DEVIATION_M
        assert tool.compute_angle(begin) < 0.02
