"""The primitive level above the real servo and the simulated arm."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.messages import Error
from tests.levels.arms import cell
from tests.levels.primitive.rack import BEND, TURN, PrimitiveRack, gripper, path, two_paths


def positions(rack: PrimitiveRack) -> np.ndarray:
    return np.array([p["position"] for p in rack.set_points if p["due"]])


def first(rack: PrimitiveRack, **wanted: int) -> int:
    """Return the index of the first status with the given fields."""
    return next(
        k
        for k, s in enumerate(rack.seen)
        if all(s[name] == value for name, value in wanted.items())
    )


@pytest.fixture(scope="module")
def finished() -> PrimitiveRack:
    """A rack that has done both paths. Tests must not change it."""
    rack = PrimitiveRack()
    rack.command(*two_paths(rack))
    assert rack.run_until_done(2)
    return rack


def test_set_points_keep_their_limits_and_agree_with_their_derivatives(
    finished: PrimitiveRack,
) -> None:
    limits = cell("puma560").limits
    made = [p for p in finished.set_points if p["due"]]
    q, qd, qdd = (
        np.array([p[name] for p in made]) for name in ("position", "velocity", "acceleration")
    )
    assert (np.abs(qd) <= limits.velocity * (1 + 1e-6)).all()
    assert (np.abs(qdd) <= limits.acceleration * (1 + 1e-6)).all()
    assert np.abs(qdd).max(axis=0) == pytest.approx(limits.acceleration, rel=1.0)
    step = 8 * 0.0025
    assert np.abs((q[2:] - q[:-2]) / (2 * step) - qd[1:-1]).max() < 0.02
    assert np.abs((qd[2:] - qd[:-2]) / (2 * step) - qdd[1:-1]).max() < 1.0
    # Each is due two cycles after the release that made it.
    dues = [int(p["due"]) for p in finished.set_points]
    assert all(due - 8 * (k + 1) == 8 for k, due in enumerate(dues) if due)
    assert np.abs(finished.servo.position - finished.home).max() < 1e-3
    assert finished.servo.clipped == finished.servo.touches == 0


def test_next_path_is_planned_while_the_arm_moves_so_that_it_does_not_wait(
    finished: PrimitiveRack,
) -> None:
    begun = first(finished, current=2)
    assert not finished.seen[begun]["resting"]
    assert finished.seen[begun]["done"] == 1
    assert finished.seen[first(finished, current=1, resting=0) + 4]["wants"] == 0


def test_every_status_reports_progress_and_when_the_segment_will_be_done(
    finished: PrimitiveRack,
) -> None:
    under_way = [s for s in finished.seen if s["current"] == 2]
    progress = [float(s["progress"]) for s in under_way]
    assert all(s["echo"] == 2 and s["state"] == State.EXECUTING for s in under_way)
    assert progress == sorted(progress)
    assert progress[-1] == 1.0
    assert finished.status.state == State.DONE
    said = finished.seen[first(finished, current=2, resting=0)]["ends"]
    done = (first(finished, done=2) + 1) * 8 * 0.0025
    assert done <= said <= done + 0.2


def test_gripper_segments_close_and_open_and_report_the_held_object() -> None:
    rack = PrimitiveRack()
    rack.command(gripper(1, opening=0.0, held=1))
    assert rack.run_until_done(1, 3.0)
    assert rack.status.held == 1
    assert rack.status.opening < 0.002
    rack.command(gripper(2, opening=0.04, held=1))
    assert rack.run_until_done(2, 3.0)
    assert rack.status.held == -1
    assert rack.status.opening > 0.038


def test_move_that_cannot_be_done_by_its_time_is_refused_before_anything_moves() -> None:
    rack = PrimitiveRack()
    rack.command(path(1, [rack.home, rack.home + TURN], by=0.7))
    refused = rack.run_until_error()
    assert refused.error == Error.TOO_LATE
    assert f"the earliest is {refused.earliest:.3f} s" in refused.reason
    rack.run(0.5)
    assert np.ptp(positions(rack), axis=0).max() == 0.0
    again = PrimitiveRack()
    again.command(path(1, [again.home, again.home + TURN], by=refused.earliest))
    assert again.run_until_done(1)
    # Done just in time.
    assert refused.earliest - 0.15 < again.seconds <= refused.earliest


@pytest.mark.slow
@pytest.mark.parametrize(
    ("offset", "fields", "said"),
    [
        (0.5, {}, "begins 0.5000 rad"),
        (0.0, {"waypoints": np.full((2, 6), np.nan)}, "not finite"),
        (0.0, {"kind": 9}, "kind 9"),
        (0.0, {"count": 0}, "shape (0, 6)"),
        (0.0, {"by": np.nan}, "not finite"),
    ],
)
def test_an_impossible_segment_is_an_error_and_the_next_command_is_carried_out(
    offset: float, fields: dict, said: str
) -> None:
    rack = PrimitiveRack()
    rack.command(path(1, [rack.home + offset, rack.home + TURN + offset]) | fields)
    status = rack.run_until_error()
    assert status.error == Error.LIMIT
    assert said in status.reason
    rack.command(path(2, [rack.home, rack.home + BEND]))
    assert rack.run_until_done(2)
    assert rack.status.error == 0


def test_an_arm_without_gripper_or_scene_follows_a_path_and_refuses_a_grasp() -> None:
    rack = PrimitiveRack("k1607")
    corner = rack.home + 0.2
    rack.command(path(1, [rack.home, corner, corner - 0.3], [0.0, 0.2, 0.0]))
    assert rack.run_until_done(1)
    assert np.abs(rack.servo.position - corner + 0.3).max() < 1e-3
    rack.command(gripper(2, opening=0.0))
    assert rack.run_until_error().reason == "segment 2: the arm has no gripper; valid: paths"
