"""The task level: programs decomposed or refused before anything moves, and times that are kept."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rack.backplane.message import REASON_BYTES, Message, State
from rack.levels.errors import Refused
from rack.levels.messages import MOVE_STATUS, TASK_PLAN, WINDOW, Error, Verb
from rack.levels.planning.motion import MotionPlanner
from rack.levels.planning.pose import Pose
from rack.levels.planning.situation import Situation
from rack.levels.task import TaskExecutor, read_program
from rack.levels.task.actions import rehearse
from rack.levels.task.finish import Cycles, Rehearsed, finish_times
from rack.levels.task.params import TaskParams
from rack.levels.task.rehearsal import Rehearsal
from tests.levels.arms import cell, config
from tests.levels.box import lose_some
from tests.levels.lockstep import BoardSpec, Lockstep
from tests.levels.whole_rack import WholeRack

ROBOT, SCENE = config("puma560")
BLOCK1, BLOCK2 = 0, 1
CYCLES = Cycles(own_s=1.0, below_s=0.25, planning_s=1.0)
TRANSFER = {"do": "transfer", "object": "block1", "to": [0.50, -0.20, 0.475]}
REACH = {"do": "goto", "position": [0.45, 0.10, 0.95]}
HOME = {"do": "home"}


@pytest.fixture(scope="module")
def start() -> Rehearsal:
    puma = cell("puma560")
    data = puma.start()
    situation = Situation(data.xpos[puma.bodies].copy(), data.xquat[puma.bodies].copy())
    return Rehearsal(MotionPlanner(puma, SCENE, 1990), puma.home, situation)


def rehearsed(start: Rehearsal, *actions: Mapping[str, Any]) -> Rehearsal:
    return rehearse(read_program({"action": list(actions)}, ROBOT, SCENE), SCENE, start)


def refusal(start: Rehearsal, action: Mapping[str, Any]) -> Refused:
    with pytest.raises(Refused) as caught:
        rehearsed(start, action)
    assert str(caught.value).startswith("action 0, ")
    assert len(str(caught.value)) <= REASON_BYTES
    return caught.value


def test_transfer_is_eight_moves_and_leaves_the_object_at_its_goal(start: Rehearsal) -> None:
    end = rehearsed(start, TRANSFER)
    verbs = [r.move.verb for r in end.moves]
    assert verbs == [
        Verb.MOVE,
        Verb.APPROACH,
        Verb.GRASP,
        Verb.DEPART,
        Verb.MOVE,
        Verb.APPROACH,
        Verb.RELEASE,
        Verb.DEPART,
    ]
    assert [r.move.id for r in end.moves] == list(range(1, 9))
    assert end.situation.held is None
    put = end.situation.object_pose(BLOCK1).position
    assert put[:2] == pytest.approx(TRANSFER["to"][:2])
    # The block's half height over the table: at most 1 mm of air below it when the gripper opens.
    assert 0.475 <= put[2] <= 0.476


def test_later_actions_know_what_earlier_ones_have_moved(start: Rehearsal) -> None:
    onto_its_place = {"do": "transfer", "object": "block2", "to": [0.50, 0.30, 0.475]}
    assert refusal(start, onto_its_place).code == Error.NO_PATH
    end = rehearsed(start, TRANSFER, onto_its_place)
    assert end.situation.object_pose(BLOCK2).position[:2] == pytest.approx([0.50, 0.30])


def test_object_is_turned_as_wanted(start: Rehearsal) -> None:
    end = rehearsed(start, {**TRANSFER, "yaw": 0.6})
    w, _, _, z = end.situation.object_pose(BLOCK1).quaternion
    assert 2.0 * np.arctan2(z, w) == pytest.approx(0.6, abs=1e-6)


@pytest.mark.parametrize(
    ("action", "code", "words"),
    [
        ({**TRANSFER, "to": [1.2, 0.0, 0.475]}, Error.UNREACHABLE, "would be over 'floor'; supports: 'table'"),
        ({**TRANSFER, "to": [0.5, -0.2, 0.9]}, Error.UNREACHABLE, "425 mm above 'table'"),
        ({**TRANSFER, "to": [0.5, -0.2, 0.44]}, Error.UNREACHABLE, "35 mm deep in 'table'; valid z: 0.475"),
        ({**TRANSFER, "to": [0.9, 0.5, 0.475]}, Error.UNREACHABLE, "out of reach: ["),
        ({**TRANSFER, "to": [0.65, 0.3, 0.475]}, Error.NO_PATH, "'block1' and 'block2'"),
        ({"do": "goto", "position": [0.5, 0.0, 0.6]}, Error.NO_PATH, "'wall'"),
        ({"do": "goto", "position": [1.5, 0.0, 0.6]}, Error.UNREACHABLE, "out of reach: ["),
        (
            {"do": "goto", "joints": [9, 0, 0, 0, 0, 0]},
            Error.UNREACHABLE,
            "joint 'j1' to 9 rad; valid: -2.788 to 2.788",
        ),
    ],
)
def test_what_cannot_be_done_is_refused_with_what_can(
    start: Rehearsal, action: Mapping[str, Any], code: Error, words: str
) -> None:
    refused = refusal(start, action)
    assert refused.code == code
    assert words in str(refused)


def test_refused_transfer_says_whether_to_pick_or_to_place_is_blocked(start: Rehearsal) -> None:
    on_block1 = Pose(np.array([0.50, 0.30, 0.526]), np.array([1.0, 0.0, 0.0, 0.0]))
    buried = replace(start, situation=start.situation.with_body(BLOCK2, on_block1))
    assert "action 0, pick block1: '" in str(refusal(buried, TRANSFER))
    taken = replace(start, situation=start.situation.with_body(BLOCK2, Pose(np.array(TRANSFER["to"]), on_block1[1])))
    assert "action 0, place block1 at [0.5, -0.2, 0.475]: '" in str(refusal(taken, TRANSFER))


def test_place_named_as_reachable_is_reachable(start: Rehearsal) -> None:
    text = str(refusal(start, {"do": "goto", "position": [1.5, 0.0, 0.6]}))
    place = [float(x) for x in text.partition("in reach: [")[2].partition("]")[0].split(",")]
    assert rehearsed(start, {"do": "goto", "position": place}).moves


def test_rehearsal_can_be_gone_back_to(start: Rehearsal) -> None:
    rehearsed(start, TRANSFER)
    assert start.moves == ()
    assert start.situation.object_pose(BLOCK1).position == pytest.approx([0.5, 0.3, 0.475])


def test_finish_times_rise_and_leave_room_for_each_motion(start: Rehearsal) -> None:
    moves = rehearsed(start, TRANSFER, HOME).moves
    times = finish_times(moves, 4.0, CYCLES, TaskParams())
    assert times[0] > 4.0 + moves[0].duration_s
    for (before, after), (_, duration_s) in zip(itertools.pairwise(times), moves[1:], strict=True):
        assert after >= before + duration_s


def test_move_with_a_time_ends_no_sooner_and_holds_up_what_follows(start: Rehearsal) -> None:
    first, second = rehearsed(start, REACH, HOME).moves
    late = Rehearsed(first.move._replace(by_s=50.0), first.duration_s)
    times = finish_times([late, second], 4.0, CYCLES, TaskParams())
    assert times[0] == pytest.approx(51.0)
    assert times[1] > 50.0 + second.duration_s


@pytest.fixture(scope="module")
def refused_run() -> WholeRack:
    rack = WholeRack(actions=[REACH, {**HOME, "by": 2.0}])
    rack.run_to_end(10.0)
    return rack


def test_time_that_cannot_be_met_is_refused_at_once_with_the_earliest(refused_run: WholeRack) -> None:
    status = refused_run.task
    earliest = refused_run.read("task.plan").earliest
    assert (status.state, status.error) == (State.ERROR, Error.TOO_LATE)
    assert f"action 1, home, by 2 s: the earliest is {earliest:.2f} s" in status.reason
    assert refused_run.primitive.done == 0
    assert not refused_run.primitive.current
    assert refused_run.read("servo.status").position == pytest.approx(ROBOT.home, abs=1e-3)


def test_earliest_time_that_was_told_can_be_met(refused_run: WholeRack) -> None:
    earliest = refused_run.read("task.plan").earliest
    rack = WholeRack(actions=[REACH, {**HOME, "by": earliest + 1e-6}])
    assert rack.run_to_end(earliest + 2.0).state == State.DONE
    assert rack.seconds <= earliest + 1.0


def test_arm_takes_the_time_that_it_is_given() -> None:
    rack = WholeRack(actions=[{**REACH, "by": 14.0}])
    assert rack.run_to_end(20.0).state == State.DONE
    # Done at the task level by then, and not a cycle of its own before.
    assert 13.0 < rack.seconds <= 14.0 + 1.0


class Bench(Lockstep):
    """The task executor alone; the test plays its planner and the level below."""

    def __init__(self, *actions: Mapping[str, Any], **params: Any) -> None:
        board = BoardSpec("task", 400, TaskExecutor, below="elemental_move", params=params)
        outside = {"task.plan": TASK_PLAN, "elemental_move.status": MOVE_STATUS}
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
        status = self.message("elemental_move.status")
        for name, value in below.items():
            setattr(status, name, value)
        self.write("elemental_move.status", status)
        for _ in range(800):
            self.step()

    @property
    def status(self) -> Message:
        """What the level reports."""
        return self.read("task.status")

    def window(self) -> list[int]:
        """Return the serials of the moves handed down."""
        command = self.read("task.command")
        return [int(serial) for serial in command.moves["id"][: command.count]]


def test_window_moves_with_what_is_done_and_ends_with_the_plan() -> None:
    bench, moves = Bench(HOME, HOME), 2 * WINDOW
    bench.plan([0] * WINDOW + [1] * WINDOW)
    assert bench.window() == list(range(1, WINDOW + 1))
    bench.cycle(done=2)
    assert bench.window() == list(range(3, WINDOW + 3))
    assert bench.status.action == 0
    bench.cycle(done=WINDOW)
    assert bench.status.action == 1
    bench.cycle(done=moves)
    assert bench.window() == list(range(WINDOW + 1, moves + 1))
    assert bench.status.state == State.DONE
    assert bench.status.action == bench.status.actions == 2


def test_refused_plan_hands_nothing_down() -> None:
    bench = Bench(HOME)
    bench.plan([], error=Error.UNREACHABLE)
    assert bench.window() == []
    assert (bench.status.state, bench.status.reason) == (State.ERROR, "no")


def test_error_below_names_the_action_that_it_ended() -> None:
    bench = Bench(HOME, HOME)
    bench.plan([0, 1])
    bench.cycle(done=1, state=State.ERROR, error=Error.FOLLOWING, reason="joint 2 strays")
    assert (bench.status.error, bench.status.reason) == (Error.FOLLOWING, "action 1: joint 2 strays")


def test_action_that_is_late_is_an_error() -> None:
    bench = Bench({**HOME, "by": 5.0})
    bench.plan([0])
    bench.cycle()
    bench.cycle()
    assert bench.seconds == 6.0
    assert bench.status.state == State.EXECUTING
    bench.cycle()
    assert (bench.status.state, bench.status.error) == (State.ERROR, Error.TOO_LATE)
    assert bench.status.reason == "action 0, home, was not done by 5 s"


def test_task_that_stands_still_ends_with_who_is_in_the_way() -> None:
    bench, below = Bench(HOME, stalled_s=5.0), {"state": State.HOLDING, "reason": "waiting for servo: brakes engaged"}
    bench.plan([0])
    bench.cycle(current=1, progress=0.1)
    assert bench.status.state == State.EXECUTING
    bench.cycle(current=1, progress=0.2, **below)
    assert (bench.status.state, bench.status.reason) == (State.HOLDING, below["reason"])
    for _ in range(2):
        bench.cycle(current=1, progress=0.2, **below)
    assert bench.status.state == State.HOLDING
    bench.cycle(current=1, progress=0.2, **below)
    assert (bench.status.state, bench.status.error) == (State.ERROR, Error.STALLED)
    assert bench.status.reason == f"nothing has moved for 5 s: {below['reason']}"


def test_task_that_moves_slowly_does_not_stand_still() -> None:
    bench = Bench(HOME, stalled_s=5.0)
    bench.plan([0])
    for k in range(8):
        bench.cycle(current=1, progress=0.01 * k)
    assert bench.status.state == State.EXECUTING


def test_task_without_a_plan_ends_and_says_so() -> None:
    bench = Bench(HOME, stalled_s=5.0)
    for _ in range(4):
        bench.cycle()
    assert bench.status.error == Error.STALLED
    assert "no plan" in bench.status.reason


@pytest.mark.parametrize(("current", "why"), [(1, "move 1 is under way"), (0, "no path yet for move 1")])
def test_task_that_nobody_holds_says_what_it_waits_for(current: int, why: str) -> None:
    bench = Bench(HOME, stalled_s=5.0)
    bench.plan([0])
    for _ in range(8):
        bench.cycle(current=current)
    assert bench.status.reason == f"nothing has moved for 5 s: {why}"


def test_task_that_an_operator_holds_stands_still_as_long_as_that_lasts() -> None:
    bench, below = Bench(HOME, stalled_s=5.0), {"state": State.HOLDING, "reason": "primitive held by the operator"}
    bench.plan([0])
    for _ in range(10):
        bench.cycle(current=1, operated=1, **below)
    assert (bench.status.state, bench.status.reason) == (State.HOLDING, below["reason"])
    for _ in range(4):
        bench.cycle(current=1)
    assert bench.status.error == Error.STALLED


def test_restarted_executor_remembers_what_was_done() -> None:
    bench = Bench(HOME)
    bench.plan([0] * (WINDOW + 2))
    bench.cycle(done=2)
    bench.restart("task")
    bench.cycle()
    assert bench.status.moves_done == 2
    assert bench.window() == list(range(3, WINDOW + 3))


def test_level_without_a_program_is_idle() -> None:
    bench = Bench()
    bench.cycle()
    assert bench.status.state == State.IDLE


@pytest.mark.parametrize(
    ("finished", "away_ticks", "published"),
    [(True, 40, 1), (True, 900, 1), (False, 40, 1)],
    ids=["plan on its way", "plan followed", "plan never made"],
)
def test_planner_that_is_lost_plans_again_only_what_was_lost(finished: bool, away_ticks: int, published: int) -> None:
    rack = WholeRack(actions=[HOME])
    rack.after(500, lambda: rack.lose("task.planner", away_ticks, finished))
    assert rack.run_to_end(20.0).state == State.DONE
    assert rack.boxes["task.plan"].at(rack.tick)[0] == published


def test_world_of_which_nothing_was_seen_is_not_planned_with() -> None:
    rack = WholeRack(actions=[HOME])
    rack.after(4, lambda: rack.lose("world", 1000))
    rack.run(2.4)
    assert rack.read("world.model").revision == 0
    assert rack.run_to_end(20.0).state == State.DONE
    assert rack.read("task.plan").count == 1
    assert rack.seconds > 5.0


def test_plan_that_is_lost_on_its_way_is_published_again() -> None:
    rack = WholeRack(actions=[HOME])
    rack.disturb("task.plan", lose_some(1.0, seed=1), 1000)
    assert rack.run_to_end(20.0).state == State.DONE
    assert rack.boxes["task.plan"].at(rack.tick)[0] == 2
