"""The primitive level above the real servo and the simulated arm."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.level import Demand
from rack.levels.messages import Error
from rack.levels.motion.path import BlendedPath
from rack.levels.primitive.path_motion import PathMotion
from rack.levels.robot.limits import Limits
from tests.levels.arms import cell
from tests.levels.lockstep import CLOCK_NS
from tests.levels.primitive.rack import BEND, TURN, PrimitiveRack, gripper, path, two_paths

FIELDS = ("position", "velocity", "acceleration")


def first(rack: PrimitiveRack, **wanted: int) -> int:
    """Return the index of the first status with the given fields."""
    shown = [all(s[name] == value for name, value in wanted.items()) for s in rack.seen]
    return shown.index(True)


@pytest.fixture(scope="module")
def finished() -> PrimitiveRack:
    """A rack that has done both paths. Tests must not change it."""
    rack = PrimitiveRack()
    rack.command(*two_paths(rack))
    assert rack.run_until_done(2)
    return rack


def test_set_points_keep_limits_and_agree_with_derivatives(finished: PrimitiveRack) -> None:
    limits = cell("puma560").limits
    made = [p for p in finished.set_points if p["due"]]
    q, qd, qdd = (np.array([p[name] for p in made]) for name in FIELDS)
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


def test_next_path_is_planned_while_the_arm_moves(finished: PrimitiveRack) -> None:
    begun = first(finished, current=2)
    assert not finished.seen[begun]["resting"]
    assert finished.seen[begun]["done"] == 1
    assert finished.seen[first(finished, current=1, resting=0) + 4]["wants"] == 0


def test_every_status_reports_progress_and_the_end(finished: PrimitiveRack) -> None:
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
    wanted = [p["position"] for p in rack.set_points if p["due"]]
    assert np.ptp(wanted, axis=0).max() == 0.0
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
def test_an_impossible_segment_is_an_error(offset: float, fields: dict, said: str) -> None:
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


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ({"following": 1e-6}, "from its set point"),
        ({"settled": 1e-12, "settling": 0.5}, "from its goal; valid: at most 1e-12 rad"),
    ],
)
def test_arm_that_does_not_follow_is_an_error_and_comes_to_rest(
    params: dict[str, float], said: str
) -> None:
    rack = PrimitiveRack(params=params)
    rack.command(path(1, [rack.home, rack.home + TURN]))
    status = rack.run_until_error()
    assert status.error == Error.FOLLOWING
    assert said in status.reason
    rack.run(1.0)
    assert rack.status.resting
    assert rack.status.done == 0


@pytest.mark.slow
@pytest.mark.parametrize(("died_at_s", "away_s"), [(0.05, 0.25), (1.2, 0.25)])
def test_a_restarted_executor_finishes_the_present_segment(died_at_s: float, away_s: float) -> None:
    rack = PrimitiveRack()
    rack.command(*two_paths(rack))
    rack.run(died_at_s)
    rack.tasks["primitive"].due = -1
    rack.run(away_s)
    rack.restart("primitive")
    assert rack.run_until_done(2)
    assert np.abs(rack.servo.position - rack.home).max() < 1e-3
    assert rack.servo.touches == 0


@pytest.mark.parametrize("died_at_s", [0.1, 1.0])
def test_a_restarted_executor_keeps_its_grip(died_at_s: float) -> None:
    rack = PrimitiveRack()
    rack.command(gripper(1, opening=0.0, held=0, force=17.0))
    rack.run(died_at_s)
    rack.tasks["primitive"].due = -1
    rack.run(0.02)
    rack.restart("primitive")
    rack.run(1.0)
    assert (rack.status.done, rack.status.held) == (1, 0)
    assert (rack.set_points[-1]["force"], rack.set_points[-1]["opening"]) == (17.0, 0.0)


def seconds(time_s: float) -> int:
    """Return a time in ticks."""
    return round(time_s * 1e9 / CLOCK_NS)


@pytest.mark.slow
def test_arm_rests_on_its_path_while_the_board_above_is_lost() -> None:
    rack = PrimitiveRack(params={"settling": 0.5, "silent": 0.5})
    rack.command(*two_paths(rack))
    rack.run(0.4)
    rack.boxes["em.command"].lost = True
    rack.run(0.5)
    assert rack.status.resting
    held_at = rack.status.progress
    assert 0.0 < held_at < 1.0
    rack.run(1.0)
    assert (rack.status.progress, rack.status.error) == (held_at, 0)
    rack.boxes["em.command"].lost = False
    assert rack.run_until_done(2)
    assert np.abs(rack.servo.position - rack.home).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("demand", [Demand.STOP, Demand.BRAKE])
def test_a_stopped_servo_is_waited_for_without_a_time_limit(demand: Demand) -> None:
    # The stop outlasts every time limit; brakes take the arm some way off its path.
    rack = PrimitiveRack(params={"silent": 0.5, "settling": 0.5, "straying": 0.02, "astray": 0.05})
    rack.command(*two_paths(rack))
    rack.run(0.4)
    rack.stop(demand, seconds(1.2))
    rack.run(1.1)
    assert (rack.status.state, rack.status.error) == (State.HOLDING, 0)
    assert rack.status.reason.startswith("waiting for servo: ")
    assert rack.set_points[-1]["due"] == 0
    assert rack.run_until_done(2)
    assert np.abs(rack.servo.position - rack.home).max() < 1e-3
    assert {int(seen["error"]) for seen in rack.seen} == {0}


@pytest.mark.slow
def test_set_points_never_jump_however_often_boards_are_lost() -> None:
    chance = np.random.default_rng(1)
    rack = PrimitiveRack()
    rack.command(*two_paths(rack))
    for _ in range(6):
        name = chance.choice(["primitive", "primitive", "primitive.planner", "servo", "world"])
        at = int(chance.integers(seconds(2.5)))
        rack.after(at, lambda name=name: rack.lose(name, int(chance.integers(1, 100))))
    assert rack.run_until_done(2)
    last = None
    for new in rack.set_points:
        assert all(np.isfinite(new[field]).all() for field in FIELDS)
        if last is not None and last["due"] and new["due"]:
            most = (new["due"] - last["due"]) * CLOCK_NS * 1e-9 * rack.fastest
            assert (np.abs(new["position"] - last["position"]) <= 1.01 * most).all()
        last = new
    assert (rack.servo.clipped, rack.servo.touches) == (0, 0)


@pytest.mark.slow
def test_a_motion_that_resumes_at_the_end_of_its_path_is_finished() -> None:
    for length in np.random.default_rng(4).uniform(0.1, 9.0, 200):
        line = BlendedPath([[0.0], [length]], [0.0, 0.0])
        motion = PathMotion(line, Limits(*np.ones((4, 1))), bridging_s=0.5)
        motion.reset_to_nearest(np.array([length]), progress=1.0)
        assert motion.is_finished


def test_a_silent_servo_is_an_error_until_a_status_arrives() -> None:
    rack = PrimitiveRack(params={"silent": 0.5})
    rack.command(*two_paths(rack))
    rack.run(0.3)
    servo = rack.tasks["servo"]
    servo.due = -1
    rack.run(0.8)
    assert rack.status.error == Error.BELOW
    assert rack.set_points[-1]["due"] == 0
    servo.due = rack.tick
    assert rack.run_until_done(2)
    assert rack.status.error == 0
