"""The end of a run, judged from its backplane: its cause, long holds, positions of objects."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.message import Message, State, Status, field
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, System
from rack.boards.events import (
    MAX_HOLD_MS,
    NO_TORQUE,
    Braking,
    Ending,
    Event,
    Journal,
    format_brakings,
    iterate_statuses,
    list_brakings,
)
from rack.levels.tables import GoalConfig
from tests.backplane.bus import CLOCK_NS, task
from tests.backplane.conftest import MakeBus
from tests.tools.faults.test_ending import box

SILENT = 40


class LevelStatus(Status, version=1):
    moves: int = field("u2", unit="1", doc="of its program")


class Braked(Status, version=1, message="arm_status"):
    braked: bool = field(doc="1: brakes are engaged")


class Scene(Message, version=1):
    """Bodies and tool as sensed."""

    position: np.ndarray = field(unit="m", doc="of each body", shape=(2, 3))


TICK_MS = CLOCK_NS * 1e-6


class Told(Message, version=1, message="command"):
    """A command."""

    id: int = field("u4", unit="1", doc="serial")


@pytest.fixture
def bus(make_bus: MakeBus) -> Segment:
    return make_bus(
        task("upper"),
        task("lower"),
        box(LevelStatus, "upper.status"),
        box(Braked, "lower.status"),
        box(Scene, "lower.scene"),
        box(Told, "lower.command"),
    )


def write(segment: Segment, name: str, tick: int = 0, **fields: Any) -> None:
    writer = open_writer(segment, name)
    for key, value in fields.items():
        setattr(writer.message, key, value)
    writer.write(tick)
    writer.close()


def ending(segment: Segment, ends_run: str | None = "upper.status") -> Ending:
    return Ending(segment, ends_run, SILENT, 0)


@pytest.mark.parametrize(
    ("state", "moves", "cause"),
    [
        (State.DONE, 0, "task done"),
        (State.EXECUTING, 0, "time over"),
        (State.IDLE, 3, "time over"),
        (State.ERROR, 3, "task failed"),
        (State.ERROR, 0, "task refused"),
    ],
)
def test_the_last_status_of_the_level_that_ends_a_run_is_its_cause(
    bus: Segment, state: State, moves: int, cause: str
) -> None:
    write(bus, "upper.status", 5, state=state, moves=moves, reason="so it is")
    assert ending(bus).find_cause() == cause
    assert ending(bus).find_final_state() == (state.name.lower(), "so it is")


@pytest.mark.parametrize(("written", "at", "is_silent"), [(5, 45, False), (5, 46, True)])
@pytest.mark.parametrize("state", [State.EXECUTING, State.DONE, State.ERROR])
def test_a_level_that_is_silent_for_too_long_has_failed_unless_it_is_done(
    bus: Segment, written: int, at: int, is_silent: bool, state: State
) -> None:
    write(bus, "upper.status", written, state=state, moves=1)
    bus.words[System.TICK] = at
    causes = {State.EXECUTING: "time over", State.DONE: "task done", State.ERROR: "task failed"}
    is_failed = is_silent and state == State.EXECUTING
    assert ending(bus).find_cause() == ("task failed" if is_failed else causes[state])
    reason = "'upper.status' has not been written for 0.1025 s" if is_failed else ""
    assert ending(bus).find_final_state() == (state.name.lower(), reason)


@pytest.mark.parametrize(
    ("longest", "cause"), [(0, "time over"), (7, "time over"), (6, "task failed")]
)
def test_a_run_that_lasted_too_long_has_failed(bus: Segment, longest: int, cause: str) -> None:
    write(bus, "upper.status", 5, state=State.HOLDING, moves=1, reason="waiting")
    bus.words[System.TICK] = 6
    found = Ending(bus, "upper.status", SILENT, longest)
    assert found.find_cause() == cause
    assert ("lockstep_end_s: waiting" in found.find_final_state()[1]) == (cause == "task failed")


def test_a_level_that_never_wrote_is_silent_from_the_start(bus: Segment) -> None:
    bus.words[System.TICK] = SILENT
    assert ending(bus).find_cause() == "time over"
    bus.words[System.TICK] = SILENT + 1
    assert ending(bus).find_cause() == "task refused"


def test_errors_of_other_levels_are_latched(bus: Segment) -> None:
    assert list(iterate_statuses(bus, "error")) == []
    write(bus, "upper.status", error=4, reason="mine")
    write(bus, "lower.status", error=0, reason="none")
    assert [board for board, _ in iterate_statuses(bus, "error")] == ["upper", "lower"]
    assert [board for board, _ in iterate_statuses(bus, "braked")] == ["lower"]
    assert (ending(bus).list_latched_faults(), ending(bus, None).list_latched_faults()) == (
        [],
        ["level 'upper': mine"],
    )
    write(bus, "lower.status", 1, error=2, reason="no arm")
    assert ending(bus).list_latched_faults() == ["level 'lower': no arm"]


RAN_MS = 40_000.0
LONG = Braking("sensors", 400, MAX_HOLD_MS + 0.1)
SHORT = Braking("no torque", 800, MAX_HOLD_MS)


@pytest.mark.parametrize(
    ("found", "is_held"),
    [
        ((), False),
        ((SHORT,), False),
        ((LONG,), True),
        ((Braking("a stop is demanded", 400, 9 * MAX_HOLD_MS),), False),
        # Together more than half of the run.
        ((SHORT,) * 4, False),
        ((SHORT,) * 5, True),
    ],
)
def test_brakes_hold_a_run_if_they_are_long_or_often_engaged(
    bus: Segment, found: tuple[Braking, ...], is_held: bool
) -> None:
    lines = list(ending(bus).find_long_holds([], found, RAN_MS))
    text = (
        f"held without a known cause, in {RAN_MS:g} ms: {format_brakings(found)}" if found else ""
    )
    assert lines == ([text] if is_held else [])


@pytest.mark.parametrize("kind", ["fault", "command"])
def test_holds_with_a_known_cause_are_not_reported(bus: Segment, kind: Any) -> None:
    assert list(ending(bus).find_long_holds([Event(0, 0, "miss", "", "")], [LONG], RAN_MS))
    assert not list(ending(bus).find_long_holds([Event(0, 0, kind, "", "")], [LONG], RAN_MS))
    bus.words[System.DEMAND] = 1
    assert not list(ending(bus).find_long_holds([], [LONG], RAN_MS))


def test_brakes_that_were_never_opened_count_from_when_the_level_has_its_state(
    bus: Segment,
) -> None:
    write(bus, "lower.status", braked=1)
    bus.get_block("lower")[Block.LEVEL_SINCE] = round((RAN_MS - MAX_HOLD_MS) / TICK_MS)
    (line,) = ending(bus).find_long_holds([], [], RAN_MS + 1.0)
    assert line.endswith("1 time, 5001 ms in all, longest 5001 ms at tick 14000: no torque (1)")
    assert list(ending(bus).find_long_holds([], [], RAN_MS)) == []
    write(bus, "lower.status", 1, braked=1, reason="no sensor")
    (line,) = ending(bus).find_long_holds([], [], RAN_MS + 1.0)
    assert line.endswith("no sensor (1)")


def test_a_level_that_holds_for_long_is_named(bus: Segment) -> None:
    write(bus, "upper.status", state=State.HOLDING, reason="waits for a part")
    block = bus.get_block("upper")
    block[Block.LEVEL_STATE] = State.HOLDING
    block[Block.LEVEL_SINCE] = 400
    assert list(ending(bus).find_long_holds([], [], 1000.0 + MAX_HOLD_MS)) == []
    assert list(ending(bus).find_long_holds([], [], 1000.0 + MAX_HOLD_MS + 1.0)) == [
        "level 'upper' held for 5001 ms without a known cause: waits for a part"
    ]
    block[Block.LEVEL_STATE] = State.EXECUTING
    assert list(ending(bus).find_long_holds([], [], 1000.0 + MAX_HOLD_MS + 1.0)) == []


def test_objects_end_where_they_were_sensed_last(bus: Segment) -> None:
    goal = GoalConfig(object="block", position=(0.1, 0.2, 0.3), tolerance_mm=5.0)
    assert ending(bus).find_object_ends({1: goal}) == ()
    write(bus, "lower.scene", position=[[0.0, 0.0, 0.0], [0.1, 0.2, 0.304]])
    (end,) = ending(bus).find_object_ends({1: goal})
    assert (end.object, end.off_mm, end.tolerance_mm) == ("block", 4.0, 5.0)
    assert str(end) == "object 'block' ended 4 mm from its goal (tolerance 5 mm)"


def test_a_journal_stamps_events_and_passes_them_on(bus: Segment) -> None:
    heard: list[Event] = []
    journal = Journal(heard.append)
    journal.add_event("launch", "rack", "first")
    journal.segment = bus
    bus.words[System.TICK] = 7
    bus.words[System.STATE] = Run.STARTING
    journal.add_event("ready", "rack", "second")
    bus.words[System.STATE] = Run.RUNNING
    journal.add_event("died", "upper", "third", "loss", at_ns=0, subject="a")
    journal.add_event("died", "upper", "fourth", tick=3)
    assert heard == journal.events
    assert [event.tick for event in heard] == [-1, -1, 7, 3]
    assert (heard[2].code, heard[2].subject, heard[2].board) == ("loss", "a", "upper")
    # At the machine's start, by CLOCK_MONOTONIC.
    assert heard[2].time_ns < heard[0].time_ns <= heard[1].time_ns <= heard[3].time_ns
    Journal(None).add_event("launch", "rack", "nobody listens")


def test_brakings_include_finished_ones_and_the_one_at_the_end() -> None:
    def change(tick: int, code: str, why: str, value: int = 0, arm: str = "arm") -> Event:
        return Event(0, tick, "reaction", arm, "", code, subject=why, value=value)

    events = [
        change(2, "brakes_opened", "", 2),  # of the start
        change(50, "brakes_closed", NO_TORQUE, 7),
        change(50, "brakes_opened", NO_TORQUE, 3),
        change(80, "brakes_closed", "sensors"),
        change(90, "brakes_opened", "sensors", 10),
        change(150, "brakes_closed", NO_TORQUE, 4),
    ]
    found = list_brakings(events, 200, 2.0)
    assert found == (
        Braking(NO_TORQUE, 47, 6.0),
        Braking("sensors", 80, 20.0),
        Braking(NO_TORQUE, 150, 100.0),
    )
    told = (
        "brakes engaged 3 times, 126 ms in all, longest 100 ms at tick 150: no torque (2),"
        " sensors (1)"
    )
    assert format_brakings(found) == told
    assert list_brakings(events[:1], 200, 2.0) == list_brakings([], 200, 2.0) == ()
    # The brakes of one arm stay engaged, although those of another have been released since.
    left = change(160, "brakes_opened", "sensors", 10, arm="left")
    assert list_brakings([*events, left], 200, 2.0)[-1] == found[-1]
