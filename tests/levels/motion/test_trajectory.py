"""Time along a path: limits of every joint, good use of them, exact ends, stretching, stopping."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rack.levels.messages import SECTIONS, WAYPOINTS
from rack.levels.motion.path import BlendedPath, PathBounds
from rack.levels.motion.trajectory import (
    PathState,
    SpeedLimits,
    Trajectory,
    compute_boundary_speeds,
    compute_reachable_speed,
    compute_speed_limits,
    make_stop,
    make_trajectory,
)
from tests.levels.arms import cell

EXACT = 1e-6
"""Rounding, relative to a limit."""


ARM = cell("puma560").limits


def random_path(seed: int, corners: int, stops: bool = False) -> BlendedPath:
    """A random walk with every corner rounded; with `stops`, some are not."""
    rng = np.random.default_rng(seed)
    waypoints = np.cumsum(rng.normal(scale=0.6, size=(corners + 2, 6)), axis=0)
    lengths = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    blend = np.zeros(corners + 2)
    blend[1:-1] = np.minimum(lengths[:-1], lengths[1:]) * rng.uniform(0.05, 0.5, corners)
    if stops:
        blend[1:-1] *= rng.random(corners) > 0.3
    return BlendedPath(waypoints, blend)


def compute_usage(path: BlendedPath, trajectory: Trajectory, samples: int = 3000) -> list[float]:
    """Return the largest parts of velocity, acceleration and jerk limits that motion uses.

    Jerk is the difference of the acceleration over a step that touches no change of section.
    """
    times = np.linspace(0.0, trajectory.duration, samples)
    velocity, acceleration = np.zeros((2, samples, path.joints))
    for k, time_s in enumerate(times):
        s, ds, dds = trajectory.evaluate_at(time_s)
        _, dq, d2q = path.evaluate(s)
        velocity[k] = dq * ds
        acceleration[k] = d2q * ds**2 + dq * dds
    jerk = np.diff(acceleration, axis=0) / (times[1] - times[0])
    limited = (velocity, ARM.velocity), (acceleration, ARM.acceleration), (jerk, ARM.jerk)
    return [float(np.max(np.abs(values) / limit)) for values, limit in limited]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "corners"), [(1, 0), (2, 1), (3, 4), (1, 9)])
def test_every_joint_keeps_velocity_acceleration_and_jerk_limits(seed: int, corners: int) -> None:
    path = random_path(seed, corners, stops=seed == 3)
    assert max(compute_usage(path, make_trajectory(path, ARM))) <= 1.0 + EXACT


@pytest.mark.parametrize("corners", [0, 1, 4, WAYPOINTS - 2])
def test_trajectory_goes_from_rest_at_the_begin_to_rest_at_the_end(corners: int) -> None:
    path = random_path(5, corners)
    trajectory = make_trajectory(path, ARM)
    assert trajectory.evaluate_at(0.0) == (0.0, 0.0, 0.0)
    end = trajectory.evaluate_at(trajectory.duration)
    assert end == pytest.approx((path.length, 0.0, 0.0), abs=1e-8)
    assert len(trajectory.sections) <= SECTIONS
    starts = trajectory.sections[1:, 0]
    before = np.array([trajectory.evaluate_at(t - 1e-9) for t in starts]).reshape(-1, 3)
    assert np.abs(before - trajectory.sections[1:, 1:4]).max(initial=0.0) < 1e-5


def test_straight_line_uses_velocity_and_acceleration_limits_fully() -> None:
    path = BlendedPath([np.zeros(6), np.array([2.5, 1.0, 0.5, 0.0, 0.0, 0.0])], [0.0, 0.0])
    assert compute_usage(path, make_trajectory(path, ARM)) == pytest.approx([1.0] * 3, abs=1e-6)


def test_motion_rests_at_every_stop_of_the_path_and_no_stop_overruns_it() -> None:
    last = np.array([0.8, 0, 0, 0, 0, 0.4])
    path = BlendedPath([np.zeros(6), np.full(6, 0.4), last], np.zeros(3))
    trajectory = make_trajectory(path, ARM)
    s, ds, *_ = trajectory.evaluate_states(np.linspace(0.0, trajectory.duration, 20_001))
    assert path.stops
    assert np.abs(ds[np.argmin(np.abs(s - path.stops[0]))]) < 0.02
    assert ds.max() > 0.5
    for time_s in np.linspace(0.0, trajectory.duration, 60):
        motion = trajectory.evaluate_at(time_s)
        stop = make_stop(path, ARM, motion)
        if stop is not None and motion.s < path.stops[0] - 1e-6:
            assert stop.end <= path.stops[0] + 1e-8


def test_a_path_without_length_takes_no_time() -> None:
    trajectory = make_trajectory(BlendedPath([np.ones(6)], [0.0]), ARM)
    assert trajectory.duration == 0.0
    assert trajectory.evaluate_at(0.0) == (0.0, 0.0, 0.0)
    stop = make_stop(random_path(15, 1), ARM, PathState(0.25, 0.0, 0.0))
    assert stop is not None
    assert (stop.begin, stop.end, stop.duration) == (0.25, 0.25, 0.0)


def test_a_stretched_trajectory_takes_exactly_the_requested_time_on_the_same_path() -> None:
    path = random_path(8, 2)
    quick = make_trajectory(path, ARM)
    slow = quick.stretch_by(7.25 / quick.duration)
    assert slow.duration == pytest.approx(7.25, rel=1e-12)
    assert slow.end == pytest.approx(quick.end, rel=1e-12)
    places = [one.evaluate_at(0.3 * one.duration).s for one in (slow, quick)]
    assert places[0] == pytest.approx(places[1], rel=1e-9)
    factor = slow.duration / quick.duration
    for power, usage in enumerate(compute_usage(path, slow), 1):
        assert usage <= 1.0 / factor**power + EXACT


def test_a_reachable_speed_needs_exactly_the_given_length() -> None:
    for start, length in [(0.0, 0.01), (0.0, 0.5), (0.3, 0.05), (0.7, 0.4)]:
        limits = SpeedLimits(100.0, 2.0, 20.0)
        change = compute_reachable_speed(start, length, limits) - start
        short = change <= limits.acceleration**2 / limits.jerk
        time_s = 2 * np.sqrt(change / limits.jerk) if short else change / 2.0 + 2.0 / 20.0
        assert (start + change / 2) * time_s == pytest.approx(length, rel=1e-6)


def test_speeds_at_boundaries_can_be_reached_from_both_sides() -> None:
    limits = [SpeedLimits(1.0, 2.0, 20.0), SpeedLimits(0.4, 0.0, 0.0), SpeedLimits(2.0, 1.0, 10.0)]
    speeds = compute_boundary_speeds([1.0, 0.2, 0.05], limits)
    assert speeds[0] == speeds[3] == 0.0
    assert speeds[1] == speeds[2] == pytest.approx(compute_reachable_speed(0.0, 0.05, limits[2]))


def test_curve_that_leaves_no_acceleration_is_followed_at_constant_speed() -> None:
    bend = PathBounds(np.full(6, 0.4), np.full(6, 1.0), np.full(6, 1.0))
    whole = compute_speed_limits(bend, ARM, share=1.0)
    part = compute_speed_limits(bend, ARM, share=0.75)
    assert whole.acceleration == 0.0
    assert part.acceleration > 0.0
    assert part.speed < whole.speed


@pytest.mark.slow
@pytest.mark.parametrize("corners", [0, 1, 3])
def test_stop_keeps_the_joint_limits_and_stays_on_the_path(corners: int) -> None:
    path = random_path(10 + corners, corners, stops=corners == 3)
    trajectory = make_trajectory(path, ARM)
    braking = replace(ARM, acceleration=1.5 * ARM.acceleration, jerk=1.5 * ARM.jerk)
    stops = 0
    for time_s in np.linspace(0.0, trajectory.duration, 40):
        motion = trajectory.evaluate_at(time_s)
        stop = make_stop(path, braking, motion)
        if stop is None or stop.duration == 0.0:
            continue
        stops += 1
        assert stop.evaluate_at(0.0) == pytest.approx(motion, abs=1e-9)
        assert stop.evaluate_at(stop.duration)[1:] == pytest.approx((0.0, 0.0), abs=1e-6)
        assert motion.s <= stop.end <= path.length + 1e-8
        velocity, acceleration, jerk = compute_usage(path, stop, 200)
        assert velocity <= 1.0 + EXACT
        assert max(acceleration, jerk) <= 1.5 + 1e-5
    assert stops > 20
