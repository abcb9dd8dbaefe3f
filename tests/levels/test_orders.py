"""How a level follows its operator: what stands, what is refused, and what its status says of it."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message, status
from rack.levels.operator import ANSWER, OPERATOR_COMMAND, Answer, Goal, What
from rack.levels.orders import Orders, joints_of

TAKES = {What.HOLD: (), What.RESUME: (), What.GOTO: (Goal.JOINTS, Goal.HOME)}
STATUS = status("told", 1, *ANSWER)
RANGES = np.array([[-1.0, 1.0], [0.0, 2.0]])


def said(serial: int, what: What, goal: Goal = Goal.NONE, verdict: Verdict = Verdict.NEW) -> Reading:
    message = Message(OPERATOR_COMMAND.dtype({}))
    message.id, message.what, message.goal = serial, what, goal
    return Reading(message, verdict)


def report(orders: Orders, above: int = 0, message: Message | None = None) -> Message:
    """Return what the status says; `message` is that of the cycle before, whose values stay."""
    message = Message(STATUS.dtype({})) if message is None else message
    orders.report(message, above)
    return message


def test_what_was_said_stands_until_resume() -> None:
    orders = Orders(TAKES)
    assert orders.take(said(3, What.HOLD))
    assert not orders.take(said(3, What.HOLD, verdict=Verdict.OLD))
    assert orders.standing is What.HOLD
    assert orders.take(said(5, What.RESUME))
    assert (orders.standing, orders.answer) == (What.NONE, Answer.DONE)


def test_a_command_given_twice_is_taken_up_once() -> None:
    orders = Orders(TAKES)
    orders.take(said(4, What.HOLD))
    orders.take(said(5, What.RESUME))
    assert not orders.take(said(4, What.HOLD))
    assert orders.standing is What.NONE


@pytest.mark.parametrize(
    ("what", "goal"), [(What.SETPOINT, Goal.JOINTS), (What.GOTO, Goal.POSE), (What.HOLD, Goal.HOME)]
)
def test_what_the_level_does_not_take_is_refused_and_changes_nothing(what: What, goal: Goal) -> None:
    orders = Orders(TAKES)
    orders.take(said(1, What.HOLD))
    assert not orders.take(said(2, what, goal))
    told = report(orders)
    assert (told.order, told.answer, told.standing) == (2, Answer.REFUSED, What.HOLD)
    name = f"{what.name} {goal.name}".lower()
    assert told.objection == f"{name} is nothing for this level; permitted: hold, resume, goto joints|home"
    # The torque still rests on the one before.
    assert told.operator == 1


def test_a_number_that_means_nothing_is_refused() -> None:
    orders = Orders(TAKES)
    reading = said(1, What.NONE)
    reading.value.what = 99
    assert not orders.take(reading)
    assert report(orders).objection.startswith("99 is nothing for this level")


def test_a_status_rests_on_the_newest_of_here_and_above() -> None:
    orders = Orders(TAKES)
    assert orders.rests_on(3) == 3
    orders.take(said(5, What.HOLD))
    assert (orders.rests_on(3), orders.rests_on(8)) == (5, 8)
    assert report(orders, above=8).operator == 8


def test_what_was_given_up_holds() -> None:
    orders = Orders(TAKES)
    orders.take(said(5, What.GOTO, Goal.HOME))
    orders.fail("out of reach")
    told = report(orders)
    assert (told.standing, told.answer, told.objection) == (What.HOLD, Answer.REFUSED, "out of reach")
    assert told.operator == 5
    orders.done()
    assert report(orders, message=told).answer == Answer.REFUSED


def test_only_what_is_under_way_comes_to_be_done() -> None:
    orders = Orders(TAKES)
    orders.done()
    assert report(orders).answer == Answer.NONE
    orders.take(said(5, What.HOLD))
    assert report(orders).answer == Answer.TAKEN
    orders.done()
    assert report(orders).answer == Answer.DONE


@pytest.mark.parametrize(
    ("joints", "why"),
    [
        ((0.0,), "1 joint positions; the arm has 2 joints"),
        ((0.0, 2.5), "joint 'elbow' at 2.5 rad; permitted: 0 to 2"),
        ((np.nan, 1.0), "joint 'base' at nan rad; permitted: -1 to 1"),
    ],
)
def test_joints_that_cannot_be_name_the_joint_and_its_range(joints: tuple[float, ...], why: str) -> None:
    message = said(1, What.GOTO, Goal.JOINTS).value
    message.count = len(joints)
    message.joints[: len(joints)] = joints
    with pytest.raises(ValueError, match=why.replace("(", r"\(")):
        joints_of(message, ("base", "elbow"), RANGES)


def test_joints_at_the_ends_of_their_ranges_can_be() -> None:
    message = said(1, What.GOTO, Goal.JOINTS).value
    message.count = 2
    message.joints[:2] = (-1.0, 2.0)
    assert joints_of(message, ("base", "elbow"), RANGES).tolist() == [-1.0, 2.0]
