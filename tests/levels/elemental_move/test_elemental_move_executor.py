"""The executor of the elemental move level alone; the test plays the levels around it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from rack.backplane.message import Message, State
from rack.levels.algebra import Array
from rack.levels.elemental_move import ElementalMoveExecutor
from rack.levels.messages import Error, MovePlan, PrimitiveStatus, SegmentKind, TaskCommand, Verb
from rack.levels.operator import ABOVE_LOST, BELOW_LOST
from tests.levels.arms import config
from tests.levels.lockstep import BoardSpec, Lockstep

EVERY = 100
BLOCK = 0
PICK = (Verb.MOVE, Verb.APPROACH, Verb.GRASP, Verb.DEPART, Verb.MOVE)


class Bench(Lockstep):
    """The executor with mailboxes that the test writes."""

    def __init__(self, **params: Any) -> None:
        places = {"above": "task", "below": "primitive"}
        board = BoardSpec("elemental_move", EVERY, ElementalMoveExecutor, **places, params=params)
        robot, scene = config("puma560")
        outside = {"task.command": TaskCommand, "primitive.status": PrimitiveStatus}
        outside["elemental_move.plan"] = MovePlan
        super().__init__([board], robot, scene, outside=outside)
        self.home = np.array(robot.home)
        self.below = self.message("primitive.status")
        self.below.resting, self.below.held, self.below.opening = 1, -1, 0.04
        self.below.position = self.home
        self.ends = {0: self.home}

    def cycle(self, cycles: int = 1, **below: object) -> None:
        """Show the primitive level's status with fields changed, and run some cycles."""
        for name, value in below.items():
            setattr(self.below, name, value)
        self.write("primitive.status", self.below)
        for _ in range(cycles * EVERY):
            self.step()

    def order(self, verbs: Sequence[Verb] = PICK, first: int = 1, by: float = 0.0) -> None:
        command = self.message("task.command")
        for k, verb in enumerate(verbs):
            command.moves[k]["id"], command.moves[k]["verb"] = first + k, verb
            command.moves[k]["object"], command.moves[k]["by"] = BLOCK, by
        command.count, command.id = len(verbs), first + len(verbs) - 1
        self.write("task.command", command)

    def plan(self, move: int, start: Array | None = None, replan: int = 0, error: int = 0) -> None:
        """Publish a path for a move, from `start` or the end of the path before, or a refusal."""
        plan = self.message("elemental_move.plan")
        plan.move, plan.replan, plan.kind, plan.error = move, replan, SegmentKind.PATH, error
        plan.reason = "something is there" if error else ""
        plan.count = 0 if error else 2
        begin = self.ends[max(m for m in self.ends if m < move)] if start is None else start
        plan.waypoints[:2] = begin, begin + 0.1
        if not (error or replan):
            self.ends[move] = begin + 0.1
        self.write("elemental_move.plan", plan)
        self.cycle()

    @property
    def command(self) -> Message:
        return self.read("elemental_move.command")

    @property
    def status(self) -> Message:
        return self.read("elemental_move.status")

    def segments(self) -> list[tuple[int, int]]:
        """Return serial and move of the segments handed down."""
        window = self.command.segments[: self.command.count]
        return [(int(s["id"]), int(s["move"])) for s in window]


def planned_bench(**params: Any) -> Bench:
    """A bench with paths for the motions of `PICK`."""
    bench = Bench(**params)
    bench.order()
    for move in (1, 2, 4, 5):
        bench.plan(move)
    bench.cycle(2)
    return bench


def test_window_stays_full_until_the_program_is_done() -> None:
    bench = planned_bench()
    assert bench.segments() == [(1, 1), (2, 2)]
    # Contacts are permitted on approach and depart alone.
    assert bench.command.segments["touch"].tolist() == [0, 1]
    bench.cycle(2, done=1)
    assert bench.segments() == [(2, 2), (3, 3)]
    gripper, segment = config("puma560")[0].gripper, bench.command.segments[1]
    assert gripper is not None
    assert (segment["kind"], segment["object"]) == (SegmentKind.GRIPPER, BLOCK)
    assert (segment["opening"], segment["force"]) == (gripper.closed, gripper.force)
    bench.cycle(2, done=2)
    assert bench.segments() == [(3, 3), (4, 4)]
    assert (bench.status.done, bench.status.verb) == (2, Verb.GRASP)
    bench.cycle(2, done=3, opening=0.022, held=BLOCK)
    assert bench.status.state == State.EXECUTING
    assert bench.segments() == [(4, 4), (5, 5)]
    for segment in (4, 5):
        bench.cycle(2, done=segment)
    assert (bench.status.state, bench.status.done) == (State.DONE, 5)
    assert bench.segments() == []


CLOSED, MISSED = "the gripper has closed to", "it holds nothing"
LOST, STRAYS = "of its way: the object is lost", "joint 2 strays"


@pytest.mark.parametrize(
    ("below", "error", "reason"),
    [
        ({"done": 3, "opening": 0.0005}, Error.GRASP_MISSED, f"{CLOSED} 1.2% of its way: {MISSED}"),
        ({"done": 3, "opening": 0.022, "held": BLOCK}, Error.OBJECT_LOST, f"{CLOSED} 0.0% {LOST}"),
        (
            {"state": State.ERROR, "error": Error.FOLLOWING, "reason": STRAYS},
            Error.FOLLOWING,
            STRAYS,
        ),
    ],
)
def test_failure_stops_all_with_a_reason(below: dict[str, Any], error: Error, reason: str) -> None:
    bench = planned_bench()
    bench.cycle(2, done=2)
    bench.cycle(2, **below)
    bench.cycle(2, opening=0.0)
    status = bench.status
    assert (status.state, status.error, status.reason) == (State.ERROR, error, reason)
    assert bench.segments() == []
    assert bench.command.hold == 1


def test_request_is_dropped_when_the_way_is_free_again() -> None:
    bench = planned_bench()
    bench.cycle(2, current=1, blocked=1)
    # The answer to an older request is not taken.
    bench.plan(1, replan=bench.status.replan - 1)
    bench.cycle(2)
    assert bench.segments() == [(1, 1), (2, 2)]
    bench.cycle(2, blocked=0)
    assert (bench.command.hold, bench.status.replan) == (0, 0)
    assert bench.segments() == [(1, 1), (2, 2)]


def test_another_path_replaces_the_blocked_one_and_withdraws_later_segments() -> None:
    bench = planned_bench(replans=1)
    bench.cycle(2, current=1, blocked=1, position=bench.home + 0.05)
    assert (bench.command.hold, bench.status.replan > 0) == (1, True)
    assert bench.status.start == pytest.approx(bench.home + 0.05)
    bench.plan(1, bench.home + 0.05, replan=bench.status.replan)
    bench.cycle(1)
    assert bench.segments()[0] == (3, 1)
    assert bench.command.segments[0]["waypoints"][0] == pytest.approx(bench.home + 0.05)
    bench.cycle(2, current=3, blocked=0)
    assert bench.command.hold == 0
    assert bench.segments() == [(3, 1), (4, 2)]
    assert bench.status.replans == 1
    # The next move may take as many other paths again.
    bench.cycle(2, done=3, current=4, blocked=1)
    assert (bench.status.error, bench.status.replan > 0) == (Error.NONE, True)


def test_a_path_that_stays_blocked_is_an_error_that_names_the_obstacle() -> None:
    # As where the guard sees a collision that the planner does not.
    bench = planned_bench(replans=3)
    why = "blocked: 'pad_left' and 'block1' are -7.1 mm apart; valid: 0.0 mm"
    for _ in range(3):
        serial = bench.segments()[0][0]
        bench.cycle(2, current=serial, blocked=1, state=State.HOLDING, reason=why)
        assert (bench.status.state, bench.status.reason) == (State.HOLDING, why)
        bench.plan(1, bench.home, replan=bench.status.replan)
    bench.cycle(2, current=bench.segments()[0][0])
    assert (bench.status.state, bench.status.error) == (State.ERROR, Error.BLOCKED)
    assert bench.status.reason == f"3 other paths tried, still {why}"
    assert bench.segments() == []


def test_a_deadline_is_handed_down_minus_the_time_of_the_answer() -> None:
    bench = Bench()
    bench.order([Verb.MOVE_JOINTS], by=20.0)
    bench.plan(1)
    bench.cycle(2)
    # The report of the level below waits a cycle to be read, this level's a cycle to be seen.
    assert 18.0 < bench.command.segments[0]["by"] <= 20.0 - 2 * 0.25


def test_a_refusal_is_an_error_only_when_its_move_is_due() -> None:
    bench = Bench()
    bench.order()
    bench.plan(1)
    bench.plan(2, error=Error.UNREACHABLE)
    bench.cycle(4, current=1)
    assert bench.status.state == State.EXECUTING
    bench.cycle(2, done=1, current=0)
    assert (bench.status.state, bench.status.error) == (State.ERROR, Error.UNREACHABLE)
    assert bench.status.reason == "something is there"


def test_restarted_executor_continues_from_its_own_last_messages() -> None:
    bench = planned_bench()
    bench.cycle(2, done=1)
    bench.restart("elemental_move")
    bench.cycle(2)
    assert bench.segments() == [(2, 2), (3, 3)]
    # The path of move 4 is lost with the old executor, and the planner sees that.
    assert bench.status.planned == 3
    bench.plan(4)
    bench.cycle(2, done=2)
    assert bench.segments() == [(3, 3), (4, 4)]


@pytest.mark.parametrize(
    ("mailbox", "reason", "hold"),
    [("task.command", ABOVE_LOST, 1), ("primitive.status", BELOW_LOST, 0)],
)
def test_the_loss_of_a_neighbour_is_reported(mailbox: str, reason: str, hold: int) -> None:
    bench = planned_bench()
    bench.boxes[mailbox].lost = True
    bench.cycle(2)
    assert bench.command.hold == hold
    assert (bench.status.state, bench.status.reason) == (State.HOLDING, reason)
    assert bench.segments() == [(1, 1), (2, 2)]
    bench.boxes[mailbox].lost = False
    bench.cycle(2)
    assert bench.command.hold == 0
    assert (bench.status.state, bench.status.reason) == (State.EXECUTING, "")
