"""The comparison of the two racks of one hand: its tables, its picture, and how far pulls move the
object."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rack.levels.systems.hand.messages import GraspKind
from rack.tools.lab.benches.hand import shift_mm
from rack.tools.lab.benches.hand_figures import HandBench, HandFigures, LinkFigures

COMMANDS = LinkFigures(
    "tension_command", "tendon", "hand", "double-buffer", 2.0, 0.0, 0.1, 1.0, 1.5, 4000, 0, 0
)
STATUSES = LinkFigures(
    "hand_status", "hand", "joint", "double-buffer", 2.0, 0.0, 0.2, 0.5, 0.75, 4000, 0, 9
)
TABLES = HandFigures(
    "hic", "lockstep", 1, (COMMANDS, STATUSES), 2.25, 0.5, 120.0, 300.0, 0.0, 3, 40_000, ("ab",), ""
)
INTERRUPTS = replace(
    TABLES,
    rack="condor",
    links=(
        replace(COMMANDS, writers="index, middle", protocol="interrupt", age_max_ms=3.5, lost=7),
    ),
    handler_ms=80.0,
    failure="condor: lost its grasp",
)


def test_both_racks_are_next_to_each_other_message_by_message() -> None:
    lines = list(HandBench((TABLES, INTERRUPTS)).lines())
    rows = [line.split() for line in lines if line.startswith(("tension_command", "hand_status"))]
    assert [(row[0], row[1]) for row in rows] == [
        ("tension_command", "hic,"),
        ("tension_command", "condor,"),
        ("hand_status", "hic,"),
    ]
    assert rows[1][-3:] == ["4000", "7", "0"]
    assert ["hic,", "lockstep", "2.25", "0.50", "120.0", "300.0", "0.0", "3", "40000", "done"] in [
        row.split() for row in lines
    ]
    assert lines[-1] == "condor, lockstep: condor: lost its grasp"


def test_a_failed_run_fails_the_bench() -> None:
    assert HandBench((TABLES,)).worked
    assert not HandBench((TABLES, INTERRUPTS)).worked


def test_the_document_has_every_figure(tmp_path: Path) -> None:
    found = json.loads(json.dumps(HandBench((TABLES, INTERRUPTS)).document()))
    assert [one["rack"] for one in found["racks"]] == ["hic", "condor"]
    assert found["racks"][0]["links"][1] == {**STATUSES.__dict__}


@pytest.mark.slow
def test_it_is_drawn(tmp_path: Path) -> None:
    paths = HandBench((TABLES, INTERRUPTS)).plot(tmp_path)
    assert [path.name for path in paths] == ["hand.png", "hand.svg"]
    assert paths[0].read_bytes().startswith(b"\x89PNG")


class Run:
    """A recording of a hand that holds a can from 1 s to 5 s, pulled from 2 s to 3 s; a tick is 0.1
    s."""

    def __init__(self, held_until: float = 5.0) -> None:
        pull = SimpleNamespace(at=2.0, seconds=1.0, body="can")
        scene = SimpleNamespace(push=(pull,), objects=("cup", "can"))
        boards = {"grasp": SimpleNamespace(ends_run=True), "hand": SimpleNamespace(ends_run=False)}
        self.rack_config = SimpleNamespace(scene=scene, board=boards)
        box = SimpleNamespace(name="hand.scene", message="scene")
        self.layout = SimpleNamespace(clock_ns=100_000_000, mailboxes=(box,))
        ticks = np.arange(60)
        place = np.zeros((60, 2, 3))
        place[20:30, 1, 0] = 0.004
        place[30:, 1, 1] = 0.001
        kind = np.where((ticks >= 10) & (ticks < 10 * held_until), GraspKind.HOLD, GraspKind.CLOSE)
        self.signals: dict[tuple[str, str], Any] = {
            ("hand.scene", "tick"): ticks,
            ("hand.scene", "position"): place,
            ("grasp.status", "tick"): ticks,
            ("grasp.status", "kind"): kind,
        }

    def signal(self, mailbox: str, field: str) -> np.ndarray:
        return np.asarray(self.signals[mailbox, field])


def test_the_shift_is_that_of_the_object_under_the_pull_and_after_it() -> None:
    assert shift_mm(Run()) == pytest.approx((4.0, 1.0))  # type: ignore[arg-type]


def test_an_object_that_is_let_go_before_the_end_of_the_pulls_has_no_shift() -> None:
    assert shift_mm(Run(held_until=2.5)) is None  # type: ignore[arg-type]


def test_an_object_that_was_not_seen_before_the_pulls_has_no_shift() -> None:
    run = Run()
    for field in ("tick", "position"):
        run.signals["hand.scene", field] = run.signals["hand.scene", field][20:]
    assert shift_mm(run) is None  # type: ignore[arg-type]
