"""The operator's commands: how a level follows them, and in a whole rack."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message, State
from rack.levels.operator import (
    Answer,
    AnsweringStatus,
    Goal,
    Operation,
    OperatorCommand,
    Orders,
    find_answered_serial,
    read_joint_goal,
)
from tests.levels.lockstep import Operator
from tests.levels.whole_rack import WholeRack

pytestmark = pytest.mark.thorough

TAKES = {Operation.HOLD: (), Operation.RESUME: (), Operation.GOTO: (Goal.JOINTS, Goal.HOME)}


class Answering(AnsweringStatus, version=1):
    """A status that answers an operator."""


RANGES = np.array([[-1.0, 1.0], [0.0, 2.0]])


def operator_reading(serial: int, what: Operation, goal: Goal = Goal.NONE) -> Reading:
    message = OperatorCommand.zeros({})
    message.id, message.what, message.goal = serial, what, goal
    return Reading(message, Verdict.NEW)


def report(orders: Orders, above: int = 0, message: Message | None = None) -> Message:
    """Return the status; `message` is that of the last cycle, whose values stay."""
    message = Answering.zeros({}) if message is None else message
    orders.fill_status(message, above)
    return message


def test_a_command_stays_in_force_until_resume() -> None:
    orders = Orders(TAKES)
    assert orders.take_commands(operator_reading(3, Operation.HOLD))
    assert not orders.take_commands(
        operator_reading(3, Operation.HOLD)._replace(verdict=Verdict.OLD)
    )
    assert orders.standing is Operation.HOLD
    assert orders.take_commands(operator_reading(5, Operation.RESUME))
    assert (orders.standing, orders.answer) == (Operation.NONE, Answer.DONE)
    # A command given twice is taken up once.
    assert not orders.take_commands(operator_reading(3, Operation.HOLD))
    assert orders.standing is Operation.NONE


@pytest.mark.parametrize(
    ("what", "goal"),
    [(Operation.SETPOINT, Goal.JOINTS), (Operation.GOTO, Goal.POSE), (Operation.HOLD, Goal.HOME)],
)
def test_a_command_that_the_level_does_not_accept_changes_nothing(
    what: Operation, goal: Goal
) -> None:
    orders = Orders(TAKES)
    orders.take_commands(operator_reading(1, Operation.HOLD))
    report(orders)
    assert not orders.take_commands(operator_reading(2, what, goal))
    shown = report(orders)
    assert (shown.order, shown.answer, shown.standing) == (2, Answer.REFUSED, Operation.HOLD)
    name, permitted = f"{what.name} {goal.name}".lower(), "hold, resume, goto joints|home"
    assert shown.objection == f"{name} is not a command of this level; permitted: {permitted}"
    # The torque still rests on the one before.
    assert shown.operator == 1
    unknown = operator_reading(3, Operation.NONE)
    unknown.message.what = 99
    assert not orders.take_commands(unknown)
    assert report(orders).objection.startswith("99 is not a command of this level")


def test_the_level_holds_after_an_abandoned_command() -> None:
    orders = Orders(TAKES)
    orders.take_commands(operator_reading(5, Operation.GOTO, Goal.HOME))
    orders.abandon_command("out of reach")
    shown = report(orders)
    assert (shown.standing, shown.answer) == (Operation.HOLD, Answer.REFUSED)
    assert (shown.objection, shown.operator) == ("out of reach", 5)
    orders.report_done()
    assert report(orders, message=shown).answer == Answer.REFUSED


SETTING = {**TAKES, Operation.SET: (), Operation.ENABLE: ()}


def read_answer(orders: Orders) -> tuple[int, Answer, str]:
    shown = report(orders)
    return shown.order, Answer(shown.answer), shown.objection


def test_a_setting_does_not_replace_the_answer_to_the_command_in_force() -> None:
    orders = Orders(SETTING)
    orders.take_commands(operator_reading(5, Operation.GOTO, Goal.HOME))
    assert read_answer(orders) == (5, Answer.TAKEN, "")
    orders.take_commands(operator_reading(6, Operation.SET))
    assert read_answer(orders) == (6, Answer.DONE, "")
    # Nor does it make the goto a command that is done.
    assert orders.answer is Answer.TAKEN
    # Nor does one that is refused.
    goto = operator_reading(7, Operation.GOTO, Goal.JOINTS)
    orders.take_commands(goto, lambda message: orders.refuse_newest("too far"))
    orders.report_done()
    answers = {(5, Answer.DONE, ""), (7, Answer.REFUSED, "too far")}
    assert {read_answer(orders), read_answer(orders)} == answers
    # A restarted board does none of them twice.
    assert find_answered_serial(report(orders)) == 6


def test_a_goto_that_fails_after_a_setting_is_answered_under_its_serial() -> None:
    orders = Orders(SETTING)
    orders.take_commands(operator_reading(5, Operation.GOTO, Goal.HOME))
    orders.take_commands(operator_reading(6, Operation.SET))
    orders.abandon_command("out of reach")
    # Both in one cycle: shown one after the other, the newest answer to each.
    assert read_answer(orders) == (5, Answer.REFUSED, "out of reach")
    assert read_answer(orders) == (6, Answer.DONE, "")
    assert orders.format_reason("task") == "task held, `resume` releases it: out of reach"


def test_drives_that_finish_late_answer_the_command_that_started_them() -> None:
    orders = Orders(SETTING)
    orders.take_commands(operator_reading(5, Operation.HOLD))
    orders.take_commands(operator_reading(6, Operation.ENABLE))
    for serial in (5, 6):
        assert read_answer(orders) == (serial, Answer.TAKEN, "")
    orders.report_done()
    assert read_answer(orders) == (5, Answer.DONE, "")
    orders.report_completed(6)
    assert read_answer(orders) == (6, Answer.DONE, "")


@pytest.mark.parametrize(
    ("joints", "why"),
    [
        ((-1.0, 2.0), ""),
        ((0.0,), "1 joint positions; the arm has 2 joints"),
        ((0.0, 2.5), "joint 'elbow' at 2.5 rad; permitted: 0 to 2"),
        ((np.nan, 1.0), "joint 'base' at nan rad; permitted: -1 to 1"),
    ],
)
def test_an_invalid_joint_goal_names_the_joint(joints: tuple[float, ...], why: str) -> None:
    message = operator_reading(1, Operation.GOTO, Goal.JOINTS).message
    message.count = len(joints)
    message.joints[: len(joints)] = joints
    if why:
        with pytest.raises(ValueError, match=why):
            read_joint_goal(message, ("base", "elbow"), RANGES)
    else:
        assert read_joint_goal(message, ("base", "elbow"), RANGES).tolist() == list(joints)


LEVELS = ("task", "elemental_move", "primitive", "servo")
REACH = {"do": "goto", "position": [0.45, 0.10, 0.95]}
HOME = {"do": "home"}
TOUR = [REACH, HOME] * 4
"""Long enough for an operator to reach the task level in the middle of it."""
ASIDE = [0.45, 0.25, 0.90]
DOWN = [0.0, 0.0, -1.0]


def start_tour(actions: Sequence[Mapping[str, Any]] = TOUR) -> tuple[WholeRack, Operator]:
    """Return a rack whose arm is under way, and its operator."""
    rack = WholeRack(actions=actions)
    operator = Operator(rack)
    assert rack.run(10.0, lambda r: np.abs(r.read("servo.status").target_velocity).max() > 0.1)
    return rack, operator


def has_answer(level: str, answer: Answer, serial: int) -> Callable[[WholeRack], bool]:
    def is_it(rack: WholeRack) -> bool:
        found = rack.read(f"{level}.status")
        return found.order == serial and found.answer == answer

    return is_it


@pytest.mark.parametrize("level", LEVELS)
def test_a_level_held_in_motion_finishes_the_task_after_resume(level: str) -> None:
    rack, operator = start_tour([REACH, HOME])
    serial = operator.say(level, Operation.HOLD)
    assert rack.run(6.0, has_answer(level, Answer.DONE, serial))
    held = rack.read("servo.status").position.copy()
    if level != "servo":  # a restarted board holds on
        rack.lose(level, 200)
    rack.run(3.0)
    assert rack.read(f"{level}.status").standing == Operation.HOLD
    assert np.abs(rack.read("servo.status").position - held).max() < 1e-3
    # It has been passed down to the lowest level, and no level above knows of it.
    above = LEVELS.index(level)
    operators = [rack.read(f"{name}.status").operator for name in LEVELS]
    assert operators == above * [0] + (4 - above) * [serial]
    # But each of them reports that it is held, and by whom.
    statuses = [rack.read(f"{name}.status") for name in LEVELS[: min(above, 2) + 1]]
    for shown in [s for s in statuses if s.state != State.DONE]:
        assert shown.state == State.HOLDING
        assert f"{level}" in shown.reason
        assert "held by the operator" in shown.reason
    assert level == "task" or rack.move.operated
    operator.say(level, Operation.RESUME)
    assert rack.run_to_end(30.0).state == State.DONE


def test_gotos_leave_a_free_motion_and_the_program_continues_afterwards() -> None:
    rack, operator = start_tour()
    serial = operator.goto("task", ASIDE, DOWN)
    assert rack.run(20.0, lambda r: r.read("task.status").detour > 0)
    # It goes on after the task board has died.
    move = rack.task.detour
    rack.lose("task", 200)
    assert rack.run(20.0, has_answer("task", Answer.DONE, serial))
    assert rack.task.detour == move
    scene = rack.read("servo.scene")
    assert np.abs(scene.tool_position - ASIDE).max() < 5e-3
    assert rack.task.state == State.HOLDING
    why = "diverted by the operator: goto direction done; `resume` continues the program"
    assert rack.task.reason == why
    rack.run(2.0)
    assert np.abs(rack.read("servo.scene").tool_position - ASIDE).max() < 5e-3
    serial = operator.goto("task", [3.0, 0.0, 0.5], DOWN)
    assert rack.run(20.0, has_answer("task", Answer.REFUSED, serial))
    assert "cannot bring the tool to" in rack.task.objection
    assert (rack.task.standing, rack.task.state) == (Operation.HOLD, State.HOLDING)
    # The next one may come while one is under way.
    first = operator.goto("task", [0.5, 0.35, 0.90], DOWN)
    assert rack.run(20.0, has_answer("task", Answer.TAKEN, first))
    rack.run(0.3)
    second = operator.say("task", Operation.GOTO, goal=Goal.HOME)
    assert rack.run(20.0, has_answer("task", Answer.DONE, second))
    operator.say("task", Operation.RESUME)
    assert rack.run_to_end(40.0).state == State.DONE
    assert (rack.task.detour, rack.task.moves_done) == (0, rack.task.moves)
