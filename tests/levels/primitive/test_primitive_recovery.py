"""The primitive level when boards die, restart or fall silent, or the arm does not follow."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.level import Demand
from rack.levels.messages import Error
from rack.levels.motion.path import BlendedPath
from rack.levels.primitive.path_motion import PathMotion
from rack.levels.robot.limits import Limits
from tests.levels.lockstep import CLOCK_NS
from tests.levels.primitive.rack import TURN, PrimitiveRack, gripper, path, two_paths


def test_arm_that_does_not_follow_is_an_error_and_comes_to_rest() -> None:
    rack = PrimitiveRack(params={"following": 1e-6})
    rack.command(path(1, [rack.home, rack.home + TURN]))
    status = rack.run_until_error()
    assert status.error == Error.FOLLOWING
    assert "from its set point" in status.reason
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
def test_arm_rests_on_its_path_while_the_board_above_is_lost_and_continues_when_it_is_back() -> (
    None
):
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
    # The stop lasts longer than every time that may run out; brakes take the arm some way off its
    # path.
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
        rack.after(
            int(chance.integers(seconds(2.5))),
            lambda name=name: rack.lose(name, int(chance.integers(1, 100))),
        )
    assert rack.run_until_done(2)
    last = None
    for new in rack.set_points:
        assert all(
            np.isfinite(new[field]).all() for field in ("position", "velocity", "acceleration")
        )
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
