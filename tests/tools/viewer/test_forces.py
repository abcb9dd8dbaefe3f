"""Forces in the view: curves of wanted and exerted forces."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rack.levels.robot.cell import build_cell
from rack.levels.systems.force.messages import ForceStatus
from rack.tools.viewer.curves import build_task_force_curves
from rack.tools.viewer.reading import read_component
from tests.levels.systems.force.pad import pad
from tests.tools.viewer.streams import build_rows, open_stream

CLOCK_NS = 1_000_000


def test_curves_show_wanted_and_exerted_forces(tmp_path: Path) -> None:
    rows = build_rows(ForceStatus, build_cell(*pad(tmp_path), CLOCK_NS), 60)
    for name, value in (("wrench", 18.0), ("wanted", -20.0), ("selected", 1)):
        rows["message"][name][:, 2] = value
    file = tmp_path / "run.rrd"
    with open_stream(file, CLOCK_NS) as opened:
        for write in build_task_force_curves(opened.stream):
            write(opened.block(rows))
    assert read_component(file, "/forces/z").values[-1].tolist() == [-20.0, -18.0]
    assert np.isnan(read_component(file, "/forces/x").values[-1][0])
