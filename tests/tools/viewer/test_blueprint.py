"""The initial view of racks: units in titles, legends beside curves, and suitable content."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rerun.blueprint as rrb

from rack.backplane.segment import Launch
from rack.boards.config import load, resolve_layout
from rack.boards.events import Event
from rack.levels.messages import ServoStatus
from rack.levels.robot.cell import build_cell, compute_sizes
from rack.tools.viewer.blueprint import RackViews
from rack.tools.viewer.cell import MarkWriter
from rack.tools.viewer.reading import read_component
from rack.tools.viewer.stream import Moment, RowBlock, Stream, Timelines, open_recording
from rack.tools.viewer.style import LOST

Part = rrb.Container | rrb.View


def views(part: Part, first: bool = False) -> Iterator[rrb.View]:
    """Yield all views of a part, or with `first` only those that are visible at first."""
    if isinstance(part, rrb.View):
        yield part
        return
    inner = list(part.contents)
    for one in inner[:1] if first and isinstance(part, rrb.Tabs) else inner:
        yield from views(one, first)


def has_legend(view: rrb.TimeSeriesView) -> bool:
    """Return whether the legend of a plot is visible."""
    legend = view.properties["PlotLegend"]
    assert isinstance(legend, rrb.PlotLegend)
    assert legend.visible is not None
    return bool(legend.visible.as_arrow_array().to_pylist()[0])


def plots(name: str, first: bool) -> list[rrb.TimeSeriesView]:
    """Return the plots of a rack."""
    config = load(name)
    robot = config.robot
    cell = None if robot is None else build_cell(robot, config.scene, config.clock_ns)
    found = views(RackViews(resolve_layout(config), config, cell).build_all_views(), first)
    return [view for view in found if isinstance(view, rrb.TimeSeriesView)]


@pytest.mark.parametrize("name", ["nasrem", "penn", "hic"])
def test_every_plot_says_its_unit_and_only_signals_have_a_legend_over_their_curves(
    name: str,
) -> None:
    units = ("rad", "rad/s", "N", "N m", "mrad", "mm", "m", "ms", "%", "% of a core")
    unitless = {"signals", "rows lost", "taken and done"}
    found = plots(name, first=False)
    titles = {str(view.name) for view in found} - unitless
    assert titles
    assert [title for title in titles if title.rpartition(", ")[2] not in units] == []
    covered = {str(view.name) for view in found if has_legend(view)}
    assert covered == {"signals"}


@pytest.mark.parametrize(
    ("name", "contents"),
    [
        ("rccl", ["/signals/trajectory.status/done", "/signals/trajectory.status/astray"]),
        ("penn", ["/forces/task_frame/z"]),
        ("hic", ["/signals/grasp.status/load", "/hand/thumb/tensions"]),
    ],
)
def test_the_first_view_shows_what_a_rack_is_about(name: str, contents: list[str]) -> None:
    shown = [list(view.contents) for view in plots(name, first=True)]
    found = {entity.replace("\\", "") for inner in shown for entity in inner}
    assert found.issuperset(contents)


def test_brakes_and_faults_are_red_at_their_joints_while_they_last(tmp_path: Path) -> None:
    config = load("nasrem")
    assert config.robot is not None
    cell = build_cell(config.robot, config.scene, config.clock_ns)
    times = Timelines(config.clock_ns, Launch(0, 0))
    recording = open_recording("run", "run", tmp_path / "run.rrd", rrb.Blueprint(rrb.TextLogView()))
    stream = Stream(recording, times)
    marks = MarkWriter(stream, cell, config.robot.joints)
    dtype = [
        ("tick", "i8"),
        ("stamp_ns", "i8"),
        ("message", ServoStatus.message_type.build_dtype(compute_sizes(cell))),
    ]
    rows = np.zeros(9, dtype=dtype)
    rows["tick"] = np.arange(9)
    rows["message"]["braked"][3:6] = 1
    marks.write(RowBlock(rows, times))
    for tick, code in ((2, "begins"), (7, "ends")):
        text = f"sensor-nan (j3) {code}, and more"
        event = Event(0, tick, "fault", "servo", text, code, fault=0, subject="j3")
        marks.mark_fault(Moment(tick, 0), event)
    stream.close()
    for joint in config.robot.joints:
        brakes = read_component(tmp_path / "run.rrd", f"/cell/brakes/{joint}", "Points3D:positions")
        assert [len(row) for row in brakes.values] == [0, 1, 0]
        assert brakes.ticks.tolist() == [0, 3, 6]
    colour = read_component(tmp_path / "run.rrd", "/cell/brakes/j6", "Points3D:colors").values
    assert set(colour.ravel().tolist()) == {LOST}
    faults = read_component(tmp_path / "run.rrd", "/cell/faults/j3", "Points3D:labels")
    assert list(faults.values[0]) == ["fault of servo: sensor-nan (j3)"]
    places = read_component(tmp_path / "run.rrd", "/cell/faults/j3", "Points3D:positions")
    assert [len(row) for row in places.values] == [1, 0]
