"""Forces in the view: curves of wanted and exerted forces."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import rerun.blueprint as rrb

from rack.backplane.message import Message
from rack.backplane.segment import Launch
from rack.levels.robot.cell import Cell, build_cell, compute_sizes
from rack.levels.systems.force.messages import ForceStatus
from rack.tools.viewer.curves import build_task_force_curves
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


def test_curves_show_wanted_and_exerted_forces(tmp_path: Path, cell: Cell) -> None:
    wrench, wanted, selected = np.zeros((3, ROWS, 6))
    wrench[:, 2], wanted[:, 2], selected[:, 2] = 18.0, -20.0, 1
    written = Written(tmp_path)
    parts = build_task_force_curves(written.stream)
    written.write(ForceStatus, cell, parts, wrench=wrench, wanted=wanted, selected=selected)
    assert read_component(written.file, "/forces/z").values[-1].tolist() == [-20.0, -18.0]
    assert np.isnan(read_component(written.file, "/forces/x").values[-1][0])
