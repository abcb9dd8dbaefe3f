"""Forces in the view: arrows at sensed places, and curves of wanted and exerted forces."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import rerun.blueprint as rrb

from rack.backplane.message import Message
from rack.backplane.segment import Launch
from rack.levels.robot.cell import Cell, build_cell, compute_sizes
from rack.levels.systems.force.messages import ForceStatus, Wrench
from rack.tools.viewer.forces import (
    build_contact_arrows,
    build_contact_curves,
    build_task_force_curves,
    list_contacts,
)
from rack.tools.viewer.reading import read_component
from rack.tools.viewer.stream import RowBlock, Stream, Timelines, ViewPart, open_recording
from tests.levels.systems.force.pad import pad

CLOCK_NS = 1_000_000
ROWS = 60


@pytest.fixture
def cell(tmp_path: Path) -> Cell:
    return build_cell(*pad(tmp_path), CLOCK_NS)


class Written:
    """A recording of one message type, written by a part of the view."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "run.rrd"
        recording = open_recording("run", "run", self.file, rrb.Blueprint(rrb.TextLogView()))
        self._times = Timelines(CLOCK_NS, Launch(0, 0))
        self.stream = Stream(recording, self._times)

    def write(
        self, kind: type[Message], cell: Cell, parts: Iterable[ViewPart], **fields: np.ndarray
    ) -> None:
        """Write `ROWS` messages with these fields, one per tick."""
        dtype = [
            ("tick", "i8"),
            ("stamp_ns", "i8"),
            ("message", kind.message_type.build_dtype(compute_sizes(cell))),
        ]
        rows = np.zeros(ROWS, dtype=dtype)
        rows["tick"] = rows["stamp_ns"] = np.arange(ROWS)
        for name, values in fields.items():
            rows["message"][name] = values
        for write in parts:
            write(RowBlock(rows, self._times))
        self.stream.close()


def test_an_arrow_is_the_force_on_the_tool_in_the_worlds_frame(tmp_path: Path, cell: Cell) -> None:
    force = np.zeros((ROWS, 6))
    force[:, 2] = np.arange(ROWS)
    written = Written(tmp_path)
    written.write(
        Wrench, cell, [build_contact_arrows(written.stream, cell, "wrench")], wrench=force
    )
    arrows = read_component(written.file, "/cell/forces/tool", "Arrows3D:vectors")
    assert arrows.ticks.tolist() == [0, 20, 40]
    assert arrows.values[:, 0] == pytest.approx(
        np.array([[0.0, 0.0, tick / 60.0] for tick in (0, 20, 40)])
    )


def test_curves_show_wanted_and_exerted_forces(tmp_path: Path, cell: Cell) -> None:
    wrench, wanted, selected = np.zeros((3, ROWS, 6))
    wrench[:, 2], wanted[:, 2], selected[:, 2] = 18.0, -20.0, 1
    written = Written(tmp_path)
    parts = build_task_force_curves(written.stream)
    written.write(ForceStatus, cell, parts, wrench=wrench, wanted=wanted, selected=selected)
    assert read_component(written.file, "/forces/task_frame/z").values[-1].tolist() == [
        -20.0,
        -18.0,
    ]
    assert np.isnan(read_component(written.file, "/forces/task_frame/x").values[-1][0])


def test_contact_forces_are_shown_with_the_arms_limits(tmp_path: Path, cell: Cell) -> None:
    assert cell.wrist is not None
    written = Written(tmp_path)
    parts = build_contact_curves(written.stream, cell.wrist.contact_limits)
    written.write(Wrench, cell, parts, wrench=np.tile([3.0, 0.0, 4.0, 0.0, 0.6, 0.8], (ROWS, 1)))
    assert read_component(written.file, "/forces/contact/force").values[-1].tolist() == [60.0, 5.0]
    assert read_component(written.file, "/forces/contact/torque").values[-1].tolist() == [8.0, 1.0]


def test_an_arm_without_a_sensor_has_no_arrows(tmp_path: Path) -> None:
    robot, scene = pad(tmp_path)
    assert (
        list_contacts(build_cell(robot.model_copy(update={"wrist": None}), scene, CLOCK_NS)) == []
    )
