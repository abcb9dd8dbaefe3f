"""The elemental move level with the real levels below it: planning ahead and detours."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.elemental_move.planner import ElementalMovePlanner, PlanningJob
from rack.levels.messages import Verb
from rack.levels.motion.path import Path
from rack.levels.planning.moves import Move
from rack.levels.planning.pose import make_pose
from rack.levels.robot.cell import compute_sizes
from rack.levels.tables import MotionConfig
from tests.levels.arms import cell, config, context
from tests.levels.whole_rack import WholeRack

pytestmark = pytest.mark.slow

TRANSFER = {"do": "transfer", "object": "block1", "to": [0.50, -0.20, 0.475]}
ABOVE_BLOCK = {"do": "goto", "position": [0.5, 0.3, 0.6]}
HOME = {"do": "home"}
GOAL = np.array(TRANSFER["to"])
BLOCK1, POST = 0, 3


def post_moves(*legs: tuple[float, tuple[float, float, float]]) -> list[MotionConfig]:
    """Bring the post to the height of the arm, out of its reach, then along `legs`: time, place."""
    first = MotionConfig(body="post", at=1.0, to=(legs[0][1][0], 0.85, legs[0][1][2]), speed=1.0)
    return [first, *(MotionConfig(body="post", at=at, to=to, speed=0.25) for at, to in legs)]


def test_a_block_is_placed_at_its_goal_and_the_arm_hardly_waits_for_paths() -> None:
    rack = WholeRack(actions=[TRANSFER, HOME])
    seen: list[tuple[int, bool]] = []

    def watch(_: object) -> bool:
        seen.append((rack.primitive.done, bool(rack.primitive.current)))
        return rack.task.state in (State.DONE, State.ERROR)

    rack.run(30.0, watch)
    assert rack.task.state == State.DONE
    assert rack.read("world.model").position[BLOCK1] == pytest.approx(GOAL, abs=0.002)
    assert rack.read("servo.status").touches == 0
    assert rack.move.replans == 0
    # Between segments the primitive level may be idle for some of its cycles, not one of these.
    begun = next(k for k, (_, busy) in enumerate(seen) if busy)
    last = max(done for done, _ in seen)
    ended = next(k for k, (done, _) in enumerate(seen) if done == last)
    idle, longest = 0, 0
    for _, busy in seen[begun:ended]:
        idle = 0 if busy else idle + 1
        longest = max(longest, idle)
    assert longest * 10 < 100


def test_a_new_path_of_a_move_replaces_the_earlier_one() -> None:
    sizes = compute_sizes(cell("puma560"))
    planner = ElementalMovePlanner(context("elemental_move", config("puma560"), sizes=sizes))
    first, other, again = (Path(np.full((2, 6), number), np.zeros(2)) for number in range(3))
    pose, joints = make_pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])), np.zeros(6)
    moves = [Move(k, 0, Verb.MOVE, None, pose, joints, posture=False, by_s=0.0) for k in (1, 2)]
    for move, path in zip((*moves, moves[0]), (first, other, again), strict=True):
        planner._record_path(PlanningJob(move, path.waypoints[0]), path, visible_at=10)
    assert [found.path for found in planner._published] == [again, other]


@pytest.mark.thorough
def test_another_path_avoids_an_obstacle_that_moves_into_the_way() -> None:
    motion = post_moves((5.5, (0.6, 0.0, 0.9)))
    rack = WholeRack(arm="puma560_crossing", actions=[TRANSFER], motion=motion)
    assert rack.run_to_end(40.0).state == State.DONE
    assert rack.move.replans >= 1
    assert rack.read("servo.status").touches == 0
    assert rack.read("world.model").position[BLOCK1] == pytest.approx(GOAL, abs=0.003)


@pytest.mark.thorough
def test_task_waits_while_its_goal_is_blocked_and_continues_when_it_is_free() -> None:
    motion = post_moves((2.5, (0.5, 0.30, 0.95)), (8.0, (0.5, 0.85, 0.95)))
    rack = WholeRack(arm="puma560_crossing", actions=[ABOVE_BLOCK], motion=motion)
    rack.run(8.0)
    assert rack.primitive.done == 0
    assert rack.move.state == State.HOLDING
    assert "'post'" in rack.move.reason
    assert rack.run_to_end(30.0).state == State.DONE
    assert rack.move.reason == ""
    assert rack.read("servo.status").touches == 0
