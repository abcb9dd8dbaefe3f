"""The task level: programs decomposed or refused before anything moves, and times that are kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from rack.backplane.message import REASON_BYTES, State
from rack.levels.errors import Refused
from rack.levels.level import Pace
from rack.levels.messages import Error, Verb
from rack.levels.planning.motion_planner import MotionPlanner
from rack.levels.planning.moves import Move
from rack.levels.planning.pose import Pose
from rack.levels.task import TaskPlanner, read_program
from rack.levels.task.actions import rehearse
from rack.levels.task.program import TaskParams
from rack.levels.task.rehearsal import Rehearsal, Rehearsed, compute_finish_times
from tests.levels.arms import cell, config, context, find_situation
from tests.levels.whole_rack import WholeRack

ROBOT, SCENE = config("puma560")
BLOCK1, BLOCK2 = 0, 1
RATES = {"every": 400, "within_cycles": 2, "clock_ns": 2_500_000}
CONTEXT = context("task", (ROBOT, SCENE), **RATES, below={"elemental_move": Pace(100, 4)})
TRANSFER = {"do": "transfer", "object": "block1", "to": [0.50, -0.20, 0.475]}
REACH = {"do": "goto", "position": [0.45, 0.10, 0.95]}
HOME = {"do": "home"}
FAR = Error.UNREACHABLE


@pytest.fixture(scope="module")
def start() -> Rehearsal:
    puma = cell("puma560")
    return Rehearsal(MotionPlanner(puma, SCENE, 1990), puma.home, find_situation(puma))


def rehearse_actions(start: Rehearsal, *actions: Mapping[str, Any]) -> Rehearsal:
    return rehearse(read_program({"action": list(actions)}, ROBOT, SCENE), SCENE, start)


def test_transfer_is_eight_moves_and_leaves_the_object_at_its_goal(start: Rehearsal) -> None:
    end = rehearse_actions(start, {**TRANSFER, "yaw": 0.6})
    assert start.moves == ()
    assert start.situation.object_pose(BLOCK1).position == pytest.approx([0.5, 0.3, 0.475])
    verbs = [r.move.verb for r in end.moves]
    assert verbs[:4] == [Verb.MOVE, Verb.APPROACH, Verb.GRASP, Verb.DEPART]
    assert verbs[4:] == [Verb.MOVE, Verb.APPROACH, Verb.RELEASE, Verb.DEPART]
    assert [r.move.id for r in end.moves] == list(range(1, 9))
    assert end.situation.held is None
    put = end.situation.object_pose(BLOCK1).position
    assert put[:2] == pytest.approx(TRANSFER["to"][:2])
    w, _, _, z = end.situation.object_pose(BLOCK1).quaternion
    assert 2.0 * np.arctan2(z, w) == pytest.approx(0.6, abs=1e-6)
    # The block's half height over the table: at most 1 mm of air below it when the gripper opens.
    assert 0.475 <= put[2] <= 0.476


@pytest.mark.slow
@pytest.mark.parametrize(
    ("goal", "code", "words"),
    [
        ({"to": [1.2, 0.0, 0.475]}, FAR, "would be over 'floor'; supports: 'table'"),
        ({"to": [0.5, -0.2, 0.9]}, FAR, "425 mm above 'table'"),
        ({"to": [0.5, -0.2, 0.44]}, FAR, "35 mm deep in 'table'; valid z: 0.475"),
        ({"position": [0.5, 0.0, 0.6]}, Error.NO_PATH, "'wall'"),
        ({"position": [1.5, 0.0, 0.6]}, FAR, "out of reach: ["),
        ({"joints": [9, 0, 0, 0, 0, 0]}, FAR, "joint 'j1' to 9 rad; valid: -2.788 to 2.788"),
    ],
)
def test_an_impossible_action_is_refused_with_a_possible_alternative(
    start: Rehearsal, goal: dict[str, Any], code: Error, words: str
) -> None:
    with pytest.raises(Refused) as caught:
        rehearse_actions(start, (TRANSFER if "to" in goal else {"do": "goto"}) | goal)
    refused = caught.value
    assert refused.action == 0
    assert len(f"action 0, {refused}") <= REASON_BYTES
    assert refused.code == code
    assert words in str(refused)
    if "; in reach: [" in str(refused):
        place = str(refused).partition("in reach: [")[2].partition("]")[0].split(",")
        assert rehearse_actions(start, {"do": "goto", "position": [float(x) for x in place]}).moves


def test_a_move_with_a_deadline_ends_no_sooner_and_delays_later_moves(start: Rehearsal) -> None:
    first, second = rehearse_actions(start, REACH, HOME).moves
    late = Rehearsed(first.move._replace(by_s=50.0), first.duration_s)
    times = compute_finish_times([late, second], 4.0, CONTEXT, TaskParams())
    assert times[0] == pytest.approx(51.0)
    assert times[1] > 50.0 + second.duration_s


@pytest.mark.slow
def test_an_impossible_deadline_is_refused_at_once() -> None:
    rack = WholeRack(actions=[REACH, {**HOME, "by": 2.0}])
    rack.run_to_end(10.0)
    status, earliest = rack.task, rack.read("task.plan").earliest
    assert (status.state, status.error) == (State.ERROR, Error.TOO_LATE)
    assert f"action 1, home, by 2 s: the earliest is {earliest:.2f} s" in status.reason
    assert (rack.primitive.done, rack.primitive.current) == (0, 0)
    assert rack.read("servo.status").position == pytest.approx(ROBOT.home, abs=1e-3)


def test_a_deadline_on_another_racks_clock_is_not_refused_because_of_rounding() -> None:
    rack = WholeRack(actions=[{**HOME, "by": 20.0}])
    planner = rack.tasks["task.planner"].level
    assert isinstance(planner, TaskPlanner)
    pose = Pose(np.zeros(3), np.zeros(4))
    home = Move(1, 0, Verb.MOVE_JOINTS, None, pose, np.zeros(6), False, 0.0)
    for offset in np.random.default_rng(1).uniform(-20.0, 0.0, 200):
        planner._ahead_s = float(offset)  # the move is slowed down to end just in time
        planner._check_deadlines(planner._add_deadlines([Rehearsed(home, 1.0)]), 0.0)
