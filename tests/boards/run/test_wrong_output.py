"""A copy of a level that computes a wrong value is noticed by comparison, and taken out by vote."""

from __future__ import annotations

import os
from typing import Any

import pytest

from rack.backplane.fault_table import FaultTable
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.standby import ReplicatedTask, list_standbys
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.events import Event
from rack.boards.faults.describe import describe_fault
from tests.boards.config.mistakes import read_config
from tests.boards.conftest import PLANNED, UNJUDGED, MakeConfig
from tests.boards.run.test_standby import SOON, STANDBY, TWO
from tests.boards.runs import faulty

WRONG_AT = 420
SECONDS = 1.25
COMPARE, VOTE = "board.wave.compare=true", "board.wave.vote=true"
BOXES = ("wave.status", "watch.status")
Row = tuple[int, bytes]


def wrong(board: str, **others: Any) -> dict[str, Any]:
    return {"kind": "wrong-output", "board": board, "tick": WRONG_AT, "cycles": 1, **others}


class Ran:
    """A run with a fault, or without."""

    def __init__(self, config: RackConfig) -> None:
        self.rows: dict[str, list[Row]] = {box: [] for box in BOXES}
        with Rack(config) as rack:
            rings = {box: MailboxRing(rack.segment, box) for box in BOXES}
            self.digest = rack.run(SECONDS).digest
            for box, ring in rings.items():
                rows = ring.read_new_rows().rows
                self.rows[box] = [(int(row["tick"]), row["message"].tobytes()) for row in rows]
            self.tasks: tuple[ReplicatedTask, ...] = list_standbys(rack.segment)
            self.events: list[Event] = list(rack.events)
            self.text = [
                describe_fault(entry, rack.segment.layout, ())
                for entry in FaultTable(rack.segment).entries[: len(config.fault)]
            ]

    def find(self, code: str) -> list[Event]:
        return [event for event in self.events if event.code == code]


@pytest.fixture(scope="module")
def plain() -> Ran:
    return Ran(read_config(PLANNED, [f"name=test-right-{os.getpid()}", UNJUDGED]))


@pytest.mark.parametrize("copy", ["wave", "wave.standby"])
@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ({"field": 4, "bit": 3}, "wave.status.value, bit 3"),
        ({"field": 4, "offset": 0.25}, "wave.status.value, offset 0.25 1"),
        # Until the end: one difference, and no standby with the state of the active copy.
        ({"field": 4, "offset": 1.0, "cycles": 1000}, "wave.status.value, offset 1 1"),
    ],
    ids=["bit", "offset", "lasting"],
)
def test_a_wrong_output_is_named_one_cycle_later(
    config: MakeConfig, plain: Ran, copy: str, fault: dict[str, Any], text: str
) -> None:
    ran = Ran(faulty(config(STANDBY, COMPARE, SOON, UNJUDGED), wrong(copy, **fault)))
    assert ran.text == [f"wrong-output of {copy} ({text})"]
    (found,) = ran.find("differs")
    assert (found.tick, found.subject, found.board) == (
        WRONG_AT + 1,
        "wave.status",
        "wave.standby",
    )
    assert found.text == "'wave.status': a standby computes another value"
    assert ran.tasks[0].hand_overs == 0
    assert (ran.digest == plain.digest) == (copy != "wave")
    (standby,) = (one for one in ran.tasks[0].copies if not one.is_active)
    assert (standby.aligned_since is None) == ("cycles" in fault)


@pytest.mark.parametrize(
    ("copy", "active", "reason"),
    [
        ("wave", "wave.standby", "strayed"),
        ("wave.standby", "wave", "none"),
        ("wave.standby2", "wave", "none"),
    ],
)
def test_a_vote_takes_the_copy_with_a_wrong_output_out_and_nothing_else_changes(
    config: MakeConfig, plain: Ran, copy: str, active: str, reason: str
) -> None:
    ran = Ran(faulty(config(TWO, VOTE, SOON, UNJUDGED), wrong(copy, field=4, bit=3)))
    (found,) = ran.find("strayed")
    assert (found.tick, found.subject) == (WRONG_AT + 2, copy)
    assert [event.board for event in ran.find("died") + ran.find("rejoined")] == [copy, copy]
    (task,) = ran.tasks
    assert (task.active.name, task.reason) == (active, reason)
    assert all(one.aligned_since is not None for one in task.copies if not one.is_active)
    assert (ran.digest == plain.digest) == (copy != "wave")
    wrong_ticks = [
        tick
        for (tick, ours), (_, theirs) in zip(
            ran.rows["wave.status"], plain.rows["wave.status"], strict=True
        )
        if ours != theirs
    ]
    assert wrong_ticks == ([WRONG_AT] if copy == "wave" else [])


def test_nothing_but_its_readers_sees_a_wrong_output_without_a_standby(
    config: MakeConfig, plain: Ran
) -> None:
    ran = Ran(faulty(config(UNJUDGED), wrong("wave", field=4, bit=62)))
    assert not [event for event in ran.events if event.kind == "detection"]
    assert ran.digest != plain.digest
