"""The initial view of racks: units in titles, legends beside curves, and suitable content."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import rerun as rr
import rerun.blueprint as rrb

from rack.boards.config import build_rack_timing, load, resolve_layout
from rack.boards.config.cell import build_rack_cell
from rack.boards.events import Event
from rack.levels.messages import ServoStatus
from rack.tools.viewer.blueprint import CYCLES, MAX_LANES, RackViews
from rack.tools.viewer.cell import MarkWriter, write_geometry
from rack.tools.viewer.levels import COLUMN, ROW, compute_positions, name_lanes
from rack.tools.viewer.reading import read_component
from rack.tools.viewer.stream import Moment
from rack.tools.viewer.style import LOST
from tests.tools.viewer.streams import build_rows, open_stream

Part = rrb.Container | rrb.View
COLOUR = {
    rr.Boxes3D: "Boxes3D:colors",
    rr.Cylinders3D: "Cylinders3D:colors",
    rr.Capsules3D: "Capsules3D:colors",
    rr.Ellipsoids3D: "Ellipsoids3D:colors",
    rr.Mesh3D: "Mesh3D:albedo_factor",
}
OWN_LEVEL = Path(__file__).parents[3] / "configs/examples/own-level/metered.toml"


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


def plots(name: str | Path, first: bool) -> list[rrb.TimeSeriesView]:
    """Return the plots of a rack."""
    config = load(name)
    cell = None if config.robot is None else build_rack_cell(config)
    found = views(RackViews(resolve_layout(config), config, cell).build_all_views(), first)
    return [view for view in found if isinstance(view, rrb.TimeSeriesView)]


@pytest.mark.parametrize("name", ["nasrem", "penn", "hic"])
def test_every_plot_says_its_unit_and_only_signals_have_a_legend_over_their_curves(
    name: str,
) -> None:
    units = (
        "rad",
        "rad/s",
        "N",
        "N m",
        "m or rad",
        "N or N m",
        "mrad",
        "m",
        "ms",
        "%",
        "% of cycle",
    )
    unitless = {"signals", "taken and done"}
    found = plots(name, first=False)
    own = {field.unit for box in resolve_layout(load(name)).mailboxes for field in box.fields}
    signals = {f"signals, {unit}" for unit in own}
    titles = {str(view.name) for view in found} - unitless - signals
    assert titles
    assert [title for title in titles if title.rpartition(", ")[2] not in units] == []
    covered = {str(view.name) for view in found if has_legend(view)}
    assert "signals" in covered
    assert covered <= {"signals", *signals}


@pytest.mark.parametrize(
    ("name", "contents"),
    [
        ("rccl", ["/signals/trajectory.status/done", "/signals/trajectory.status/astray"]),
        ("penn", ["/forces/z"]),
        ("hic", ["/signals/grasp.status/load", "/hand/thumb/tensions"]),
        (OWN_LEVEL, ["/signals/power.status/power", "/signals/power.status/energy"]),
    ],
)
def test_the_first_view_shows_what_a_rack_is_about(name: str | Path, contents: list[str]) -> None:
    shown = [list(view.contents) for view in plots(name, first=True)]
    found = {entity.replace("\\", "") for inner in shown for entity in inner}
    assert found.issuperset(contents)


def test_own_signals_have_one_plot_for_each_unit() -> None:
    titles = {str(view.name): view for view in plots(OWN_LEVEL, first=True)}
    for unit, field in (("W", "power"), ("J", "energy")):
        assert has_legend(titles[f"own signals, {unit}"])
        assert list(titles[f"own signals, {unit}"].contents) == [f"/signals/power.status/{field}"]


@pytest.mark.parametrize("name", ["nasrem", "hic", "ibm", "rccl", "penn", "condor", OWN_LEVEL])
def test_no_lane_is_cut_off_and_higher_boards_are_above_lower_ones(name: str | Path) -> None:
    config = load(name)
    layout = resolve_layout(config)
    names = name_lanes(layout, build_rack_timing(config, layout))
    found = views(RackViews(layout, config, None).build_all_views())
    lanes = [view for view in found if isinstance(view, rrb.StateTimelineView)]
    by_title: dict[str, list[str]] = {}
    for view in lanes:
        by_title.setdefault(str(view.name), []).extend(view.contents)
        boards = [query.split("/")[2] for query in view.contents]
        if view.name == CYCLES:
            tasks = [task for task in layout.tasks if names[task.board] in boards]
            assert len(tasks) <= MAX_LANES
        elif view.name == "events":
            assert len(boards) <= MAX_LANES
    numbered = [lane for lane in names.values() if "." not in lane]
    assert by_title[CYCLES] == [f"/boards/{lane}/**" for lane in numbered]
    assert by_title["levels, whole run"][: len(numbered)] == [
        f"/levels/{lane}/**" for lane in numbered
    ]
    assert by_title["events"][: len(names)] == [f"/events/{lane}/**" for lane in names.values()]
    ranks = build_rack_timing(config, layout).ranks
    assert [lane.partition("-")[2] for lane in numbered][: sum(map(len, ranks))] == [
        board for rank in ranks for board in rank
    ]


@pytest.mark.parametrize(
    ("name", "places"),
    [
        ("nasrem", {"servo": (0, 3), "servo.planner": (1, 3), "task": (0, 0), "world": (-1, 0)}),
        ("rccl", {"joint3": (2, 2), "joint4": (0, 3), "arm": (0, 4), "world": (-1, 0)}),
        ("hic", {"grasp": (0, 0), "world": (-1, 0), "events": (-1, 1)}),
    ],
)
def test_the_graph_has_ranks_in_rows_and_other_boards_to_their_left(
    name: str, places: dict[str, tuple[int, int]]
) -> None:
    config = load(name)
    layout = resolve_layout(config)
    found = compute_positions(layout, build_rack_timing(config, layout))
    assert found.keys() == {task.name for task in layout.tasks}
    for task, (column, row) in places.items():
        assert found[task] == (column * COLUMN, row * ROW), task


def test_brakes_and_faults_are_red_at_their_joints_while_they_last(tmp_path: Path) -> None:
    config = load("nasrem")
    assert config.robot is not None
    cell = build_rack_cell(config)
    rows = build_rows(ServoStatus, cell, 9)
    rows["message"]["braked"][3:6] = 1
    with open_stream(tmp_path / "run.rrd", config.clock_ns) as opened:
        arm = write_geometry(opened.stream, cell)
        marks = MarkWriter(opened.stream, cell, config.robot.joints, ["servo"], arm)
        marks.write(opened.block(rows))
        for tick, code in ((2, "begins"), (7, "ends")):
            text = f"sensor-nan (j3) {code}, and more"
            event = Event(0, tick, "fault", "servo", text, code, fault=0, subject="j3")
            marks.mark_event(Moment(tick, 0), event)
    assert len(arm) > len(config.robot.joints)
    for part in arm:
        entity, red = "/" + "/".join(part.entity), int(LOST)
        own = int.from_bytes(part.colour.tobytes())
        colours = read_component(tmp_path / "run.rrd", entity, COLOUR[type(part.shape)])
        assert list(zip(colours.ticks, colours.values.ravel(), strict=True)) == [
            *((0, own), (0, own)),
            *((3, red), (6, own)),
        ]
    label = read_component(tmp_path / "run.rrd", "/cell/brakes", "Points3D:labels").values
    assert [list(row) for row in label if len(row)] == [["brakes engaged"]]
    faults = read_component(tmp_path / "run.rrd", "/cell/faults/j3", "Points3D:labels")
    assert list(faults.values[0]) == ["fault of servo: sensor-nan (j3)"]
    places = read_component(tmp_path / "run.rrd", "/cell/faults/j3", "Points3D:positions")
    assert [len(row) for row in places.values] == [1, 0]
