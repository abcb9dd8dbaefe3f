"""The planning level alone: it queues each request of a program once, some steps ahead."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import State
from rack.levels.errors import ProgramError
from rack.levels.level import Sender
from rack.levels.messages import Error, WorldState
from rack.levels.planning.ik import InverseKinematics
from rack.levels.robot.cell import build_cell, compute_sizes
from rack.levels.systems.trajectory.messages import MotionKind, MotionRequest, MotionStatus
from rack.levels.systems.trajectory.planner import MotionProgram, RequestExecutor, RequestPlanner
from tests.levels.arms import config, context

ROBOT, SCENE = config("puma560_crossing")
CELL = build_cell(ROBOT, SCENE, 1_000_000)
SIZES = compute_sizes(CELL)
EVERY = 100
MOVES = [{"do": "move", "joints": [0.1 * k, 1.4, -3.1, 0.0, -1.44, 0.0]} for k in range(6)]


class PlanningRig:
    """Runs a planner. The test sets the progress of the level below."""

    def __init__(self, steps: Sequence[Mapping[str, Any]], **params: Any) -> None:
        given = {"every": EVERY, "within_cycles": 2, "sizes": SIZES, "params": params}
        self.context = context("planning", (ROBOT, SCENE), task={"step": list(steps)}, **given)
        self.tick = 0
        self.below = MotionStatus.zeros(SIZES)
        self.world = WorldState.zeros(SIZES)
        self.world.quaternion[:, 0] = 1.0
        self.sent: list[np.ndarray] = []
        self.start()

    def start(self) -> None:
        self.planner = RequestPlanner(self.context)
        self.request = MotionRequest.zeros(SIZES)
        self.planner.store_output("plan", Sender(self.request, self._send, lambda: 1))

    def _send(self) -> bool:
        self.sent.append(self.request.record.copy())
        return True

    def run(self, cycles: int = 1) -> list[int]:
        """Plan for some cycles, and return the ids that were sent."""
        before = len(self.sent)
        for _ in range(cycles):
            vars(self.planner).update(
                below=Reading(self.below, Verdict.NEW), world=Reading(self.world, Verdict.NEW)
            )
            if self.planner.wanted(self.tick):
                self.planner.plan(self.tick)
            self.tick += EVERY
        return [int(record["id"]) for record in self.sent[before:]]


def test_requests_are_queued_a_few_ahead_of_the_arm() -> None:
    rig = PlanningRig(MOVES, ahead=3)
    assert rig.run(5) == [1, 2, 3]
    rig.below.taken, rig.below.done = 3, 1
    assert rig.run(5) == [4]
    rig.below.taken = rig.below.done = 4
    assert rig.run(5) == [5, 6]
    firsts = [record["joints"][0] for record in rig.sent]
    assert firsts == pytest.approx([0.1 * k for k in range(6)])


def test_a_restarted_planner_continues_after_the_newest_request_taken() -> None:
    rig = PlanningRig(MOVES, ahead=3)
    rig.run(3)
    rig.below.taken, rig.below.done = 2, 2
    rig.start()
    # Request 3 may still be in the queue. It is sent twice and carried out once.
    assert rig.run(4) == [3, 4, 5]


def test_a_request_that_is_not_taken_is_sent_again() -> None:
    rig = PlanningRig(MOVES, ahead=3)
    rig.run(2)
    rig.below.taken = 1
    assert rig.run(5) == []
    assert rig.run(5) == [2, 3]


def test_tool_goals_become_joint_positions_near_those_before() -> None:
    place = [0.45, 0.30, 0.75]
    steps = [
        {"do": "move", "position": place},
        {"do": "line", "position": [0.6, 0.1, 0.65]},
        {"do": "home"},
        {"do": "line", "position": [0.0, 0.0, 0.1], "body": "post", "live": True},
        {"do": "move", "position": [3.0, 0.0, 0.5]},
    ]
    rig = PlanningRig(steps, ahead=5)
    rig.run(3)
    ik = InverseKinematics(CELL, 1)
    assert np.allclose(ik.compute_tool_pose(rig.sent[0]["joints"]).position, place, atol=1e-4)
    joints, pose = MotionKind.JOINTS, MotionKind.POSE
    assert [record["kind"] for record in rig.sent] == [joints, pose, joints, pose, pose]
    assert (rig.sent[3]["body"], rig.sent[3]["live"]) == (SCENE.bodies.index("post"), 1)
    assert rig.sent[4]["position"].tolist() == [3.0, 0.0, 0.5]
    assert np.array_equal(rig.sent[2]["joints"], CELL.home)
    assert rig.sent[1]["body"] == -1
    assert np.allclose(rig.sent[1]["quaternion"], ik.compute_tool_pose(CELL.home).quaternion)


AT, LINE = "task.step[0]", {"do": "line", "position": [0, 0, 0]}
ONE = {"do": "move", "joints": [0.0]}


@pytest.mark.parametrize(
    ("step", "why"),
    [
        (ONE, f"{AT}.joints = [0.0]: has 1 values; must have 6, one per joint"),
        ({**LINE, "body": "car"}, f"{AT}.body = 'car': not in the scene; bodies: "),
        ({**LINE, "live": True}, "a live goal needs a body that it follows"),
        ({"do": "move"}, "a move has either position or joints"),
    ],
)
def test_a_program_that_does_not_fit_is_refused(step: dict[str, Any], why: str) -> None:
    with pytest.raises(ProgramError) as refused:
        MotionProgram.read({"step": [step]}, ROBOT, SCENE)
    assert why in str(refused.value)


def test_the_level_reports_the_program_done_or_failed() -> None:
    rig = PlanningRig(MOVES)
    level = RequestExecutor(rig.context)

    def state(done: int) -> int:
        rig.below.done = done
        vars(level).update(below=Reading(rig.below, Verdict.NEW))
        level.process(rig.tick)
        return int(level.status.state)

    assert state(0) == State.EXECUTING
    assert state(6) == State.DONE
    assert (level.status.action, level.status.actions) == (6, 6)
    rig.below.error, rig.below.reason = Error.LIMIT, "request 4: too fast"
    assert state(4) == State.ERROR
    assert level.status.reason == "request 4: too fast"
