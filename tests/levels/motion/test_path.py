"""A blended path: geometry, smoothness, bounds, degenerate cases."""

from __future__ import annotations

import numpy as np
import pytest

from rack.levels.motion.path import BlendedPath, compute_point, compute_points

CORNERED = np.array([[0.0, 0.0, 0.0], [1.0, 0.2, -0.3], [1.2, 1.0, 0.1], [0.4, 1.1, 0.9]])
BLEND = np.array([0.0, 0.3, 0.25, 0.0])


def evaluate_points(path: BlendedPath, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    q, dq, d2q = zip(*(tuple(a.copy() for a in path.evaluate(x)) for x in s), strict=True)
    return np.array(q), np.array(dq), np.array(d2q)


def test_derivatives_agree_with_finite_differences() -> None:
    path, step = BlendedPath(CORNERED, BLEND), 1e-5
    s = np.linspace(step, path.length - step, 2003)
    _, dq, d2q = evaluate_points(path, s)
    ahead, ahead_dq, _ = evaluate_points(path, s + step)
    behind, behind_dq, _ = evaluate_points(path, s - step)
    assert np.abs((ahead - behind) / (2 * step) - dq).max() < 1e-8
    # q'' has kinks where a blend ends.
    assert np.abs((ahead_dq - behind_dq) / (2 * step) - d2q).max() < 2e-4


def test_analytic_bounds_hold_and_are_tight_on_every_piece() -> None:
    path = BlendedPath(CORNERED, BLEND)
    for k, (start, end) in enumerate(zip(path.breaks[:-1], path.breaks[1:], strict=True)):
        s = np.linspace(start, end - 1e-12, 400)
        _, dq, d2q = evaluate_points(path, s)
        third = np.diff(d2q, axis=0) / (s[1] - s[0])
        assert (np.abs(dq).max(axis=0) <= path.bounds.first[k] + 1e-9).all()
        assert (np.abs(d2q).max(axis=0) <= path.bounds.second[k] + 1e-9).all()
        assert (np.abs(third).max(axis=0) <= path.bounds.third[k] + 1e-6).all()
        assert np.abs(d2q).max(axis=0) == pytest.approx(path.bounds.second[k], rel=1e-3, abs=1e-9)


def test_blends_that_touch_leave_no_line_between_them() -> None:
    path = BlendedPath([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [2.0, 1.0]], [0.0, 0.5, 0.5, 0.0])
    assert path.breaks == pytest.approx([0.0, 0.5, 1.5, 2.5, 3.0])
    whole = BlendedPath([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], [0.0, 1.0, 0.0])
    assert whole.breaks == pytest.approx([0.0, 2.0])
    assert whole.evaluate(0.0).q == pytest.approx([0.0, 0.0])
    assert whole.evaluate(2.0).q == pytest.approx([1.0, 1.0])


def test_coincident_waypoints_count_once_with_the_smaller_blend() -> None:
    # Only a corner without a blend is a stop.
    path = BlendedPath(CORNERED, [0.0, 0.0, 0.2, 0.0])
    assert path.stops == pytest.approx([np.linalg.norm(CORNERED[1])])
    straight = BlendedPath([[0.0, 0.0], [0.5, 0.5], [2.0, 2.0]], [0.0, 0.0, 0.0])
    assert straight.stops == []
    corner = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    path = BlendedPath(corner[[0, 0, 1, 1, 2]], [0.0, 0.3, 0.2, 0.4, 0.0])
    assert path.waypoints == pytest.approx(corner)
    assert path.blend == pytest.approx([0.0, 0.2, 0.0])
    nowhere = BlendedPath([[1.0, 2.0]] * 3, [0.0, 0.5, 0.0])
    assert nowhere.length == 0.0
    assert nowhere.evaluate(0.0).q == pytest.approx([1.0, 2.0])


@pytest.mark.parametrize(
    ("waypoints", "blend", "offender"),
    [
        ([[0.0], [1.0], [2.0], [1.0]], [0.0, 0.6, 0.6, 0.0], "overlap"),
        ([[0.0], [1.0], [0.5]], [0.0, 0.6, 0.0], "overlap"),
        ([[0.0], [1.0]], [0.0], "shape"),
        ([], [], "shape"),
        ([[0.0], [1.0], [2.0]], [0.0, -0.1, 0.0], "-0.1"),
        ([[0.0], [float("nan")]], [0.0, 0.0], "finite"),
    ],
)
def test_an_invalid_path_is_refused(waypoints: list, blend: list, offender: str) -> None:
    with pytest.raises(ValueError, match=offender):
        BlendedPath(waypoints, blend)


def test_compiled_points_have_the_bits_of_plain_python() -> None:
    path = BlendedPath(CORNERED, BLEND)
    plain = np.zeros((3, 3))
    for s in [*np.linspace(0.0, path.length, 997), *path.breaks]:
        compute_point(path._marks, path._table, s, plain)
        assert np.array_equal(path.evaluate(s), plain)


def test_samples_are_the_points_of_the_path_both_ends_included() -> None:
    path = BlendedPath(CORNERED, BLEND)
    samples = path.sample_points(0.01)
    places = np.linspace(0.0, path.length, len(samples))
    assert np.array_equal(samples, evaluate_points(path, places)[0])
    assert np.array_equal(samples, compute_points(path._marks, path._table, places))
    assert np.linalg.norm(np.diff(samples, axis=0), axis=1).max() <= 0.01
    assert BlendedPath(CORNERED[:1], [0.0]).sample_points(0.01).tolist() == CORNERED[:1].tolist()
