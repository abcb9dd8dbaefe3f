"""Tests holds of a rack, read from its segment: since when, why, and the releasing command."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.backplane.lines import UtilityLines
from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.message import State
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, System
from rack.boards.config import load
from rack.levels.operator import Answer, Goal, Operation
from rack.tools.monitor.holds import STANDSTILL_S, StandstillDetector, find_holds
from rack.tools.monitor.newest_messages import NewestMessages
from tests.tools.conftest import MakeSegment

TICK_S = 0.0025


@pytest.fixture
def segment(commanded: Path, rack_name: str, make_segment: MakeSegment) -> Segment:
    return make_segment(load(commanded, [f"name={rack_name}"]))


def give(segment: Segment, *whats: Operation) -> None:
    """Let an operator give commands to `upper` at ticks 100, 200, ..."""
    writer = open_writer(segment, "upper.operator")
    for number, what in enumerate(whats, 1):
        writer.message.id, writer.message.what = number, what
        writer.message.goal = Goal.HOME if what is Operation.GOTO else Goal.NONE
        writer.write(100 * number)
    writer.close()


def answer(
    segment: Segment, standing: Operation, order: int, given: Answer, state: State = State.EXECUTING
) -> None:
    writer = open_writer(segment, "upper.status")
    message = writer.message
    message.standing, message.order, message.answer, message.state = standing, order, given, state
    message.reason = "something is in the way" if state == State.HOLDING else ""
    writer.write(400)
    writer.close()


def lines(segment: Segment) -> list[str]:
    return [hold.line for hold in find_holds(NewestMessages(segment))]


def test_a_hold_or_a_diversion_of_an_operator_says_since_when_and_how_to_release_it(
    segment: Segment,
) -> None:
    release = f"to release: rack command {segment.rack} upper resume"
    give(segment, Operation.HOLD)
    answer(segment, Operation.HOLD, 1, Answer.DONE)
    assert lines(segment) == [f"upper held by the operator (hold), since 0.25 s; {release}"]
    give(segment, Operation.GOTO)
    for given, where in ((Answer.TAKEN, "goto home"), (Answer.DONE, "goto home, done")):
        answer(segment, Operation.GOTO, 1, given)
        said = f"upper diverted by the operator ({where}), since 0.25 s; {release}"
        assert lines(segment) == [said]
    # A command that was refused leaves the one before it standing.
    give(segment, Operation.GOTO, Operation.GOTO)
    answer(segment, Operation.GOTO, 2, Answer.REFUSED)
    assert [hold.since_tick for hold in find_holds(NewestMessages(segment))] == [100]


def test_a_level_that_holds_by_itself_gives_its_reason(segment: Segment) -> None:
    answer(segment, Operation.NONE, 0, Answer.NONE, State.HOLDING)
    segment.get_block("upper")[Block.LEVEL_SINCE] = 40
    assert lines(segment) == ["upper holding: something is in the way, since 0.10 s"]


def test_the_emergency_stop_is_released_by_its_reset(segment: Segment) -> None:
    UtilityLines(segment).latch_emergency_stop()
    release = f"to release: rack estop {segment.rack} --reset"
    assert lines(segment) == [f"arm braked: emergency stop, since 0.00 s; {release}"]


def test_nothing_holds_a_level_at_its_work_or_a_rack_whose_run_is_over(segment: Segment) -> None:
    answer(segment, Operation.NONE, 1, Answer.DONE)
    assert lines(segment) == []
    answer(segment, Operation.HOLD, 1, Answer.DONE)
    segment.words[System.STATE] = Run.STOPPED
    assert lines(segment) == []


def test_a_standstill_is_one_event_for_each_hold(segment: Segment) -> None:
    give(segment, Operation.HOLD)
    answer(segment, Operation.HOLD, 1, Answer.DONE)
    standstill, events = StandstillDetector(segment), []
    for second in range(20):
        segment.words[System.TICK] = round(second / TICK_S)
        events += list(standstill.list_events())
    (event,) = events
    assert (event.kind, event.code) == ("held", "standstill")
    assert (event.subject, event.since) == ("upper", 100)
    # Held since 0.25 s, looked at every second.
    assert event.tick == round((STANDSTILL_S + 1) / TICK_S)
    assert event.text.startswith(
        "nothing has moved for 6 s: upper held by the operator (hold), since 0.25 s; "
    )
