"""What is read from a rack's memory at the end of a run: the levels' last states, the arm, the
faults that struck."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rack.backplane.fault_table import FaultTable, Injection, Stage
from rack.backplane.layout import MailboxSpec
from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.message import Message, State
from rack.backplane.segment import Segment
from rack.boards.config.layout import build_field_specs
from rack.boards.faults.kind import KINDS
from rack.levels.messages import ArmState, Error, ServoStatus, TaskStatus
from rack.tools.faults.campaigns.trial import build_external_kill, format_levels, is_late
from rack.tools.faults.ending import EXTERNAL, REST_VELOCITY, list_strikes, read_arm
from tests.backplane.bus import mailbox, task
from tests.backplane.conftest import MakeBus

SIZES = {"joints": 2, "state": 3}


def box(kind: type[Message], name: str) -> MailboxSpec:
    return replace(
        mailbox(name=name, writer=name.partition(".")[0]),
        readers=(),
        message=kind.message_type.name,
        version=kind.message_type.version,
        size=kind.message_type.build_dtype(SIZES).itemsize,
        fields=build_field_specs(kind.message_type, SIZES),
    )


@pytest.fixture
def segment(make_bus: MakeBus) -> Segment:
    boxes = (TaskStatus, "task.status"), (ServoStatus, "servo.status"), (ArmState, "arm.state")
    tasks = task("task"), task("servo", slot=3), task("arm", slot=4)
    return make_bus(*(box(kind, name) for kind, name in boxes), *tasks)


def write(segment: Segment, name: str, **fields: object) -> None:
    """Write a message of these fields; the other fields are 0."""
    writer = open_writer(segment, name)
    for field, value in fields.items():
        setattr(writer.message, field, value)
    writer.write(0)
    writer.close()


def test_the_last_states_of_levels_are_reported_with_their_reasons(segment: Segment) -> None:
    assert format_levels(segment) == ""
    write(segment, "arm.state", tick=1)
    write(segment, "task.status", state=State.ERROR, reason="no path")
    assert format_levels(segment) == "task error (no path)"
    write(segment, "servo.status", state=State.EXECUTING)
    assert format_levels(segment) == "task error (no path), servo executing"


def test_only_a_level_that_gave_up_because_of_a_time_is_late(segment: Segment) -> None:
    assert not is_late(segment)
    write(segment, "servo.status", state=State.EXECUTING, error=Error.NONE)
    for state, error, late in (
        (State.ERROR, Error.NO_PATH, False),
        (State.EXECUTING, Error.TOO_LATE, False),
        (State.ERROR, Error.TOO_LATE, True),
    ):
        write(segment, "task.status", state=state, error=error)
        assert is_late(segment) is late


def test_the_arm_is_as_its_board_last_reported_it(segment: Segment) -> None:
    still = read_arm(segment)
    assert (still.violations, still.touches, still.is_at_rest) == (0, 0, True)
    for speed, rests in ((0.5, True), (-0.5, True), (-2.0, False)):
        velocity = (0.0, speed * REST_VELOCITY)
        write(segment, "servo.status", violations=3, touches=2, velocity=velocity)
        end = read_arm(segment)
        assert (end.violations, end.touches, end.is_at_rest) == (3, 2, rests)


def test_strikes_come_from_the_fault_table_and_from_outside_kills(segment: Segment) -> None:
    table = FaultTable(segment)
    bias, mute = KINDS["sensor-bias"], KINDS["mute"]
    joint = tuple(1.0 if p.name == "joint" else 0.25 for p in bias.parameters)
    injected = Injection(bias.number, 1, tick=40, ticks=400, seed=7, parameters=joint)
    begun = table.add_fault(injected)
    waits = table.add_fault(Injection(mute.number, 0, mailbox=0, tick=90))
    begun.stage = Stage.ACTIVE
    begun.record_action(43)
    first, second = list_strikes(segment, ("shoulder", "elbow"))
    assert (first.kind, first.board) == ("sensor-bias", "servo")
    assert (first.began, first.tick, first.count) == (40, 43, 1)
    assert (first.joint, first.mailboxes) == ("elbow", ("servo.status",))
    assert first.injection is not None
    assert (first.injection.seed, first.injection.parameters) == (7, joint)
    # It waits, so it has not begun.
    assert (second.kind, second.began, second.tick, second.count) == ("mute", -1, -1, 0)
    assert (second.fault, second.joint) == (waits.index, "")
    kill = build_external_kill(segment.layout, "task", 60, 5_000)
    assert (kill.fault, kill.kind, kill.board) == (-1, EXTERNAL, "task")
    assert (kill.began, kill.ends, kill.tick) == (60, 60, 60)
    assert (kill.time_ns, kill.mailboxes) == (5_000, ("task.status",))
