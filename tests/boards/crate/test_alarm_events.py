"""Alarms as events: raised in the rings of a real segment, and read as the Rack reads them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest

from rack.backplane.address_map import CLOCK
from rack.backplane.errors import DamageError
from rack.backplane.fault_table import FaultTable
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import (
    BRAKED_BY_DEMAND,
    BRAKED_WITHOUT_TORQUE,
    MISSES,
    Alarm,
    AlarmWriter,
    open_alarm_ring,
)
from rack.backplane.words import Demand
from rack.boards.config import load, resolve_layout
from rack.boards.config.cell import find_geom_name
from rack.boards.config.injections import build_injections
from rack.boards.config.published import PublishedFinding, PublishedLevel
from rack.boards.crate.alarm_events import AlarmReader
from rack.boards.events import Event
from rack.levels.messages import Error
from rack.levels.robot.cell import build_cell
from tests.boards.conftest import MakeConfig, MakeSegment
from tests.boards.fault_racks import rack

JOINTS = ("shoulder", "elbow")
FINDINGS = (
    PublishedFinding("own", "1", "a number of its own"),
    PublishedFinding("contact", "N m", "the arm touches something"),
)
FAULTS = (
    {"kind": "mute", "board": "wave", "mailbox": "wave.status", "for": "100ms"},
    {"kind": "sensor-bias", "board": "driven", "joint": 1, "size": 0.1},
    {"kind": "kill", "board": "clock"},
)
KINDS = {
    **dict.fromkeys(Alarm, "detection"),
    **dict.fromkeys(MISSES, "miss"),
    Alarm.FAULT_BEGINS: "fault",
    Alarm.FAULT_ENDS: "fault",
    Alarm.REJOINED: "recovery",
    Alarm.TAKEN_OVER: "recovery",
    Alarm.FLOWS: "recovery",
    Alarm.DEMAND: "reaction",
    Alarm.BRAKES_CLOSED: "reaction",
    Alarm.BRAKES_OPENED: "recovery",
    Alarm.RE_REFERENCED: "recovery",
    Alarm.REMOTE_STOP: "command",
    Alarm.NOT_SWITCHED: "command",
    Alarm.SCHEDULER_KEPT: "command",
    Alarm.PEER_BACK: "recovery",
    Alarm.PEER_RESTARTED: "recovery",
    Alarm.LATCHED: "reaction",
    Alarm.QUEUE_FULL: "held",
    Alarm.INBOX_FULL: "held",
}


@pytest.fixture
def segment(config: MakeConfig, make_segment: MakeSegment) -> Segment:
    found = rack(config, *FAULTS)
    layout = resolve_layout(found)
    made = make_segment(layout, found.to_toml_text())
    for fault in build_injections(found, layout):
        FaultTable(made).add_fault(fault)
    return made


def heard(
    segment: Segment,
    owner: str,
    alarm: Alarm,
    subject: int = -1,
    value: float = 0.0,
    since: int | None = None,
    text: str = "",
    geom: Callable[[int], str] = str,
) -> Event:
    """Ring an alarm at tick 400 and return the event that it makes."""
    AlarmWriter(segment, owner).raise_alarm(400, alarm, subject, value, since, text)
    row = open_alarm_ring(segment, owner).read_new_rows().rows[-1]
    wave = PublishedLevel(names=("first", "second"), findings=FINDINGS)
    reader = AlarmReader(segment)
    reader._joints, reader._geom, reader._levels = JOINTS, geom, {"wave": wave}
    return reader.read_row(row, owner).event


@pytest.mark.parametrize(
    ("number", "said", "text"),
    [
        (0, "", "own: 3.25, a number of its own"),
        (1, "", "contact: 3.25 N m, the arm touches something"),
        (1, "gripper\x1b[2J", r"contact: 3.25 N m, gripper\x1b[2J"),
        (1, "ü" * 100, f"contact: 3.25 N m, {'ü' * 72}"),
    ],
)
def test_a_finding_that_a_level_declares_has_its_name_value_and_unit(
    segment: Segment, number: int, said: str, text: str
) -> None:
    event = heard(segment, "wave", Alarm.OWN, number, 3.25, text=said)
    assert (event.kind, event.code, event.board, event.value, event.text) == (
        "detection",
        FINDINGS[number].name,
        "wave",
        3.25,
        text,
    )


def test_a_refused_scheduler_is_reported_of_its_board_with_the_reason(segment: Segment) -> None:
    event = heard(segment, "clock", Alarm.SCHEDULER_KEPT, 0, 2.0, text="not permitted")
    board = segment.layout.tasks[0].name
    assert (event.board, event.subject) == (board, board)
    refused = "earliest-deadline-first refused: not permitted"
    assert event.text == f"'{board}' goes on as before: {refused}"


@pytest.mark.parametrize(("owner", "number"), [("wave", 2), ("watch", 0)])
def test_a_finding_that_no_level_has_declared_is_damage(
    segment: Segment, owner: str, number: int
) -> None:
    with pytest.raises(DamageError, match=f"{number} is not the index of a finding"):
        heard(segment, owner, Alarm.OWN, number)


# Operator commands come from the operator table: see test_operator.py and test_desk.py.
OF_OPERATORS = (Alarm.COMMANDED, Alarm.OPERATOR_GONE)
TOLD_HERE = [alarm for alarm in Alarm if alarm not in OF_OPERATORS]


@pytest.mark.parametrize("alarm", TOLD_HERE, ids=lambda alarm: alarm.name.lower())
def test_every_alarm_makes_an_event_of_its_kind(segment: Segment, alarm: Alarm) -> None:
    event = heard(segment, "wave", alarm, subject=0, value=2.0)
    assert (event.kind, event.tick, event.value) == (KINDS[alarm], 400, 2.0)
    assert event.text
    assert "{" not in event.text
    if event.kind != "fault":
        assert event.code == alarm.name.lower()


@pytest.mark.parametrize(
    ("owner", "alarm", "subject", "value", "text"),
    [
        (CLOCK, Alarm.HANG, 2, 4, "'watch' is not responding: 4 releases missed since tick 360"),
        (CLOCK, Alarm.LATE, 0, 1, "'wave' missed its deadline: still running at its next release"),
        (
            "watch",
            Alarm.STALE,
            0,
            12,
            "'wave.status' is stale, 12 ticks (30 ms): its writer 'wave' is dead or stopped",
        ),
        ("watch", Alarm.GAP, 0, 2, "'wave.status': 2 messages lost, gap in serials"),
        (
            "watch",
            Alarm.MASQUERADE,
            0,
            4711,
            "'wave.status': a message comes from process 4711, which is not",
        ),
        ("driven", Alarm.SENSOR_RANGE, 1, float("nan"), "sensor elbow out of range: nan rad"),
        (
            "driven",
            Alarm.ACTUATOR,
            7,
            0.5,
            "joint 7 does not move as its torque commands: off by 0.5",
        ),
        ("driven", Alarm.BRAKES_CLOSED, BRAKED_BY_DEMAND, 0, "brakes engaged: a stop is demanded"),
        ("driven", Alarm.BRAKES_CLOSED, Error.SENSORS, 0, "brakes engaged: sensors"),
        (
            "driven",
            Alarm.BRAKES_CLOSED,
            BRAKED_WITHOUT_TORQUE,
            4,
            "brakes engaged: no torque for 4 ticks (10 ms)",
        ),
        ("driven", Alarm.BRAKES_OPENED, -1, 40, "brakes released after 40 ticks (100 ms)"),
    ],
)
def test_an_alarm_has_names_and_units(
    segment: Segment, owner: str, alarm: Alarm, subject: int, value: float, text: str
) -> None:
    event = heard(segment, owner, alarm, subject, value, since=360)
    assert event.text.startswith(text)
    assert (event.board, event.since, event.fault) == (owner, 360, -1)


def test_a_rejoin_names_the_task(segment: Segment) -> None:
    event = heard(segment, CLOCK, Alarm.REJOINED, 2, 200)
    assert (event.board, event.subject, event.text) == (
        "watch",
        "watch",
        "'watch' rejoined after 200 ticks (500 ms)",
    )
    assert heard(segment, CLOCK, Alarm.REJOINED, -1, 4).board == CLOCK


@pytest.mark.parametrize(
    ("subject", "demand", "kind", "text"),
    [
        (0, Demand.STOP, "reaction", "the arm must ramp to rest, then brake: 'wave' is lost"),
        (-1, Demand.BRAKE, "reaction", "the arm must brake at once: the emergency stop is latched"),
        (-1, Demand.NONE, "recovery", "arm released: no stop is requested"),
    ],
)
def test_a_demand_is_a_reaction_and_its_end_a_recovery(
    segment: Segment, subject: int, demand: Demand, kind: str, text: str
) -> None:
    event = heard(segment, CLOCK, Alarm.DEMAND, subject, demand)
    assert (event.kind, event.code, event.text) == (kind, "demand", text)
    assert event.subject == ("wave" if subject == 0 else "emergency stop")


@pytest.mark.parametrize(
    ("fault", "board", "subject", "text"),
    [
        (0, "wave", "wave.status", "mute (wave.status) begins, for 40 ticks (100 ms)"),
        (1, "driven", "elbow", "sensor-bias (elbow, size 0.1 rad) begins"),
        (2, CLOCK, "", "kill begins"),
    ],
)
def test_a_fault_names_its_target(
    segment: Segment, fault: int, board: str, subject: str, text: str
) -> None:
    event = heard(segment, CLOCK, Alarm.FAULT_BEGINS, fault)
    assert (event.code, event.fault, event.board, event.subject, event.text) == (
        "begins",
        fault,
        board,
        subject,
        text,
    )


def test_the_end_of_a_fault_reports_how_often_it_acted(segment: Segment) -> None:
    FaultTable(segment).entries[2].record_action(400)
    event = heard(segment, CLOCK, Alarm.FAULT_ENDS, 2, 1.0)
    assert (event.code, event.value, event.text) == ("ends", 1.0, "kill ends; acted 1 time")


def test_a_collision_names_both_geoms(segment: Segment) -> None:
    config = load("crossing")
    assert config.robot is not None
    cell = build_cell(config.robot, config.scene, config.clock_ns)
    post, palm = (cell.model.geom(name).id for name in ("post", "palm"))
    geom = partial(find_geom_name, config)
    event = heard(segment, "wave", Alarm.COLLISION, post, palm, geom=geom)
    assert (event.code, event.subject) == ("collision", "post")
    assert event.text == "unintended contact: 'post' touches 'palm'"
