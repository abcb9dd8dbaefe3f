"""An operator beside the levels: holds at every one, goto at the task level; and the task is done all the same."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.messages import Verb
from rack.levels.operator import Answer, Goal, What
from tests.levels.operators import Operator
from tests.levels.whole_rack import WholeRack

LEVELS = ("task", "elemental_move", "primitive", "servo")
REACH = {"do": "goto", "position": [0.45, 0.10, 0.95]}
TRANSFER = {"do": "transfer", "object": "block1", "to": [0.50, -0.20, 0.475]}
HOME = {"do": "home"}
TOUR = [REACH, HOME] * 4
"""Long enough for an operator to reach the task level in the middle of it."""
ASIDE = [0.45, 0.25, 0.90]
DOWN = [0.0, 0.0, -1.0]


def is_under_way(rack: WholeRack) -> bool:
    return bool(np.abs(rack.read("servo.status").target_velocity).max() > 0.1)


def answers(level: str, answer: Answer, serial: int) -> Callable[[WholeRack], bool]:
    def is_it(rack: WholeRack) -> bool:
        found = rack.read(f"{level}.status")
        return found.order == serial and found.answer == answer

    return is_it


@pytest.mark.parametrize("level", LEVELS)
def test_a_level_that_was_held_in_motion_goes_on_to_the_end_of_the_task(level: str) -> None:
    rack = WholeRack(actions=[REACH, HOME])
    operator = Operator(rack)
    assert rack.run(10.0, is_under_way)
    serial = operator.say(level, What.HOLD)
    assert rack.run(6.0, answers(level, Answer.DONE, serial))
    held = rack.read("servo.status").position.copy()
    rack.run(2.0)
    assert np.abs(rack.read("servo.status").position - held).max() < 1e-3
    # It has gone all the way down, and no level above knows of it.
    above = LEVELS.index(level)
    assert [rack.read(f"{name}.status").operator for name in LEVELS] == above * [0] + (4 - above) * [serial]
    # But every one of them says that it is kept from its work, and by whom.
    statuses = [rack.read(f"{name}.status") for name in LEVELS[: min(above, 2) + 1]]
    for status in [s for s in statuses if s.state != State.DONE]:
        assert status.state == State.HOLDING
        assert f"{level}" in status.reason
        assert "held by the operator" in status.reason
    assert level == "task" or rack.move.operated
    operator.say(level, What.RESUME)
    assert rack.run_to_end(30.0).state == State.DONE


@pytest.mark.parametrize("level", ["elemental_move", "primitive", "task"])
def test_a_restarted_board_holds_on(level: str) -> None:
    rack = WholeRack(actions=[REACH, HOME])
    operator = Operator(rack)
    assert rack.run(10.0, is_under_way)
    serial = operator.say(level, What.HOLD)
    assert rack.run(6.0, answers(level, Answer.DONE, serial))
    held = rack.read("servo.status").position.copy()
    rack.lose(level, 200)
    rack.run(3.0)
    assert rack.read(f"{level}.status").standing == What.HOLD
    assert np.abs(rack.read("servo.status").position - held).max() < 1e-3
    operator.say(level, What.RESUME)
    assert rack.run_to_end(30.0).state == State.DONE


def test_a_goto_leaves_a_free_motion_and_the_program_goes_on_behind_it() -> None:
    rack = WholeRack(actions=TOUR)
    operator = Operator(rack)
    assert rack.run(10.0, is_under_way)
    serial = operator.goto("task", ASIDE, DOWN)
    assert rack.run(20.0, answers("task", Answer.DONE, serial))
    scene = rack.read("servo.scene")
    assert np.abs(scene.tool_position - ASIDE).max() < 5e-3
    assert rack.task.detour > 0
    assert rack.task.state == State.HOLDING
    assert rack.task.reason == "diverted by the operator: goto direction done; `resume` continues the program"
    rack.run(2.0)
    assert np.abs(rack.read("servo.scene").tool_position - ASIDE).max() < 5e-3
    operator.say("task", What.RESUME)
    assert rack.run_to_end(40.0).state == State.DONE
    assert rack.task.detour == 0


def test_a_goto_takes_the_next_one_from_where_it_is() -> None:
    rack = WholeRack(actions=TOUR)
    operator = Operator(rack)
    assert rack.run(10.0, is_under_way)
    first = operator.goto("task", ASIDE, DOWN)
    assert rack.run(20.0, answers("task", Answer.TAKEN, first))
    rack.run(2.0)
    second = operator.say("task", What.GOTO, goal=Goal.HOME)
    assert rack.run(20.0, answers("task", Answer.DONE, second))
    operator.say("task", What.RESUME)
    assert rack.run_to_end(40.0).state == State.DONE
    assert rack.task.moves_done == rack.task.moves


def test_what_is_done_with_an_object_is_done_before_a_goto() -> None:
    rack = WholeRack(actions=[TRANSFER, HOME])
    operator = Operator(rack)
    assert rack.run(20.0, lambda r: r.read("elemental_move.status").verb == Verb.APPROACH)
    serial = operator.goto("task", ASIDE, DOWN)
    assert rack.run(30.0, answers("task", Answer.DONE, serial))
    assert rack.task.moves_done < rack.task.moves
    # The block is taken and not put down, or put down and left alone.
    next_move = rack.read("task.plan").moves["verb"][rack.task.moves_done]
    assert next_move in (Verb.MOVE, Verb.MOVE_JOINTS)
    operator.say("task", What.RESUME)
    assert rack.run_to_end(60.0).state == State.DONE
    assert np.abs(rack.read("world.model").position[0] - TRANSFER["to"]).max() < 0.01


def test_a_goto_that_cannot_be_is_refused_and_the_task_goes_on_behind_it() -> None:
    rack = WholeRack(actions=TOUR)
    operator = Operator(rack)
    assert rack.run(10.0, is_under_way)
    serial = operator.goto("task", [3.0, 0.0, 0.5], DOWN)
    assert rack.run(20.0, answers("task", Answer.REFUSED, serial))
    assert "cannot bring the tool to" in rack.task.objection
    assert (rack.task.standing, rack.task.state) == (What.HOLD, State.HOLDING)
    operator.say("task", What.RESUME)
    assert rack.run_to_end(40.0).state == State.DONE


def test_a_goto_goes_on_when_the_board_of_the_task_level_has_died() -> None:
    rack = WholeRack(actions=TOUR)
    operator = Operator(rack)
    assert rack.run(10.0, is_under_way)
    serial = operator.goto("task", ASIDE, DOWN)
    assert rack.run(20.0, lambda r: r.read("task.status").detour > 0)
    move = rack.task.detour
    rack.lose("task", 200)
    assert rack.run(20.0, answers("task", Answer.DONE, serial))
    assert rack.task.detour == move
    operator.say("task", What.RESUME)
    assert rack.run_to_end(40.0).state == State.DONE


def test_set_points_in_the_middle_of_a_transfer_do_not_hinder_it() -> None:
    rack = WholeRack(actions=[TRANSFER, HOME])
    operator = Operator(rack)
    assert rack.run(20.0, lambda r: r.read("elemental_move.status").verb == Verb.DEPART)
    goal = rack.read("servo.status").target + np.array([0.1, 0.1, 0.0, 0.0, 0.0, 0.0])
    serial = operator.say("servo", What.SETPOINT, goal)
    assert rack.run(10.0, answers("servo", Answer.DONE, serial))
    operator.say("servo", What.RESUME)
    assert rack.run_to_end(60.0).state == State.DONE
