"""The task level alone: the test plays its planner and the level below, or arm and world."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from rack.backplane.message import Message, State
from rack.levels.level import Executor, Input, Output
from rack.levels.messages import (
    WINDOW_MOVES,
    Error,
    MoveStatus,
    ServoStatus,
    TaskCommand,
    TaskPlan,
    WorldState,
)
from rack.levels.task import TaskExecutor, TaskPlanner
from tests.levels.arms import cell, config
from tests.levels.lockstep import BoardSpec, Lockstep

ROBOT, SCENE = config("puma560")
HOME = {"do": "home"}


class Bench(Lockstep):
    """The task executor alone; the test plays its planner and the level below."""

    def __init__(self, *actions: Mapping[str, Any], **params: Any) -> None:
        board = BoardSpec("task", 400, TaskExecutor, below="elemental_move", params=params)
        outside = {"task.plan": TaskPlan, "elemental_move.status": MoveStatus}
        super().__init__([board], ROBOT, SCENE, {"action": list(actions)}, outside=outside)

    def plan(self, actions: list[int], error: Error = Error.NONE) -> None:
        """Publish a plan with one move for each entry of `actions`."""
        plan = self.message("task.plan")
        plan.id, plan.error, plan.reason, plan.count = 1, error, "no" if error else "", len(actions)
        plan.moves["id"][: len(actions)] = np.arange(len(actions)) + 1
        plan.moves["action"][: len(actions)] = actions
        self.write("task.plan", plan)
        self.cycle()

    def cycle(self, **below: object) -> None:
        """Show a status of the level below with the given fields, and run two cycles."""
        self.show("elemental_move.status", **below)
        for _ in range(800):
            self.step()

    @property
    def status(self) -> Message:
        return self.read("task.status")

    def window(self) -> list[int]:
        """Return the serials of the moves handed down."""
        command = self.read("task.command")
        return [int(serial) for serial in command.moves["id"][: command.count]]


def test_the_window_moves_with_completed_moves_and_ends_with_the_plan() -> None:
    bench, moves = Bench(HOME, HOME), 2 * WINDOW_MOVES
    bench.plan([0] * WINDOW_MOVES + [1] * WINDOW_MOVES)
    assert bench.window() == list(range(1, WINDOW_MOVES + 1))
    bench.cycle(done=2)
    assert bench.window() == list(range(3, WINDOW_MOVES + 3))
    assert bench.status.action == 0
    bench.cycle(done=WINDOW_MOVES)
    assert bench.status.action == 1
    bench.cycle(done=moves)
    assert bench.window() == list(range(WINDOW_MOVES + 1, moves + 1))
    assert bench.status.state == State.DONE
    assert bench.status.action == bench.status.actions == 2


def test_no_moves_of_a_refused_plan_are_handed_down() -> None:
    bench = Bench(HOME)
    bench.plan([], error=Error.UNREACHABLE)
    assert bench.window() == []
    assert (bench.status.state, bench.status.reason) == (State.ERROR, "no")
    # Without a program the level is idle.
    bench = Bench()
    bench.cycle()
    assert bench.status.state == State.IDLE


def test_a_late_action_is_an_error() -> None:
    bench = Bench({**HOME, "by": 5.0})
    bench.plan([0])
    bench.cycle()
    bench.cycle()
    assert bench.seconds == 6.0
    assert bench.status.state == State.EXECUTING
    bench.cycle()
    assert (bench.status.state, bench.status.error) == (State.ERROR, Error.TOO_LATE)
    assert bench.status.reason == "action 0, home, was not done by 5 s"


HELD = {"state": State.HOLDING, "reason": "waiting for servo: brakes engaged"}


@pytest.mark.parametrize(
    ("plan", "below", "why"),
    [
        ([0], {"current": 1, **HELD}, HELD["reason"]),
        ([0], {"current": 1}, "move 1 is under way"),
        ([0], {}, "no path yet for move 1"),
        ([], {}, "no plan yet: the objects must be at rest and the position of the arm known"),
    ],
)
def test_a_stalled_task_has_a_reason(plan: list[int], below: dict[str, Any], why: str) -> None:
    bench = Bench(HOME, stalled_s=5.0)
    if plan:
        bench.plan(plan)
    for _ in range(4):  # an operator prevents motion
        bench.cycle(**below, operated=True)
    for k in range(4):  # the arm moves slowly
        bench.cycle(**below, progress=0.01 * k if plan else 0.0)
    held = "reason" in below
    if plan:
        assert bench.status.state == (State.HOLDING if held else State.EXECUTING)
        assert bench.status.reason == (why if held else "")
    for _ in range(4):
        bench.cycle(**below)
    status = bench.status
    assert (status.state, status.error) == (State.ERROR, Error.STALLED)
    assert status.reason == f"nothing has moved for 5 s: {why}"


class Obedient(Executor):
    """A level below that does every move as soon as it is shown."""

    above = Input(TaskCommand, "above.command")
    status = Output(MoveStatus)

    def process(self, tick: int) -> None:
        self.status.done = self.above.message.id


class PlannedBench(Lockstep):
    """Executor and planner of the task level; arm and resting objects are seen from tick 4 on."""

    def __init__(self, *actions: Mapping[str, Any]) -> None:
        outside = {"servo.status": ServoStatus, "world.model": WorldState}
        boards = [
            BoardSpec("task", 400, TaskExecutor, TaskPlanner, 2, below="elemental_move"),
            BoardSpec("elemental_move", 100, Obedient, above="task"),
        ]
        super().__init__(boards, ROBOT, SCENE, {"action": list(actions)}, outside=outside)
        self.after(4, lambda: self.show("servo.status", target=np.array(ROBOT.home)))
        self.after(4, lambda: self.show_start(cell("puma560")))


@pytest.mark.parametrize(
    ("finished", "away", "published"),
    [(True, 40, 1), (True, 900, 1), (False, 40, 1)],
    ids=["plan on its way", "plan followed", "plan never made"],
)
def test_a_restarted_planner_replans_only_once(finished: bool, away: int, published: int) -> None:
    bench = PlannedBench(HOME)
    bench.after(500, lambda: bench.lose("task.planner", away, finished))
    assert bench.run(20.0, until=lambda rack: rack.read("task.status").state == State.DONE)
    for seconds in (0.0, 5.0):
        bench.run(seconds)
        assert bench.boxes["task.plan"].at(bench.tick)[0] == published
