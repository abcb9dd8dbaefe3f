"""The first look: what the viewer shows of a run, without a click."""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from rack.backplane.layout import Layout
from rack.boards.config import RackConfig, rack_timing
from rack.levels.messages import SERVO_STATUS
from rack.levels.robot.cell import Cell
from rack.tools.viewer import timing as ages
from rack.tools.viewer import timing as load
from rack.tools.viewer.activity import LEVELS, LOG
from rack.tools.viewer.document import CONFIG
from rack.tools.viewer.events import EVENTS
from rack.tools.viewer.eye import eye_on
from rack.tools.viewer.fields import SIGNALS
from rack.tools.viewer.geometry import CELL, COLLISION
from rack.tools.viewer.hierarchy import COLUMN, HIERARCHY, ROW, positions
from rack.tools.viewer.joints import ERROR, GRIPPER, JOINTS, QUANTITIES
from rack.tools.viewer.lanes import lanes_view
from rack.tools.viewer.own import RECORDER
from rack.tools.viewer.poses import FRAMES
from rack.tools.viewer.stream import path
from rack.tools.viewer.timelines import SIM_TIME
from rack.tools.viewer.timing import BOARDS

CYCLES_S = 0.022
"""What the Gantt lanes show before and behind the time that is looked at: some cycles of fast and of slower boards."""


def blueprint(layout: Layout, config: RackConfig, cell: Cell | None, live: bool) -> rrb.Blueprint:
    """Return the blueprint of a rack: its cell in 3D, curves, lanes, log; `live` follows the newest data."""
    has_arm = cell is not None and any(mailbox.message == SERVO_STATUS.name for mailbox in layout.mailboxes)
    names = config.robot.joints if config.robot is not None and has_arm else ()
    doing = lanes_view("levels and events, whole run", [_all(EVENTS), _all(LEVELS)])
    below = rrb.Horizontal(doing, _graph(layout, config), column_shares=[3, 2])
    left = below if cell is None else rrb.Vertical(_cell_view(cell), below, row_shares=[11, 9])
    right = rrb.Vertical(
        _joints(names) if names else _curves("signals", [_all(SIGNALS)]),
        lanes_view("boards, cycle by cycle", [_all(BOARDS)], CYCLES_S),
        rrb.Horizontal(_load(config), _ages(layout), _log(), column_shares=[3, 3, 4]),
        row_shares=[4, 5, 3],
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[2, 3]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=SIM_TIME, play_state="following" if live else "paused"),
        auto_views=False,
        auto_layout=False,
    )


def _cell_view(cell: Cell) -> rrb.View:
    contents = [_all(CELL), f"- {path(CELL, COLLISION)}/**", _all(FRAMES)]
    return rrb.Spatial3DView(
        origin=path(CELL), contents=contents, name="cell", eye_controls=eye_on(cell), line_grid=False
    )


def _joints(names: Sequence[str]) -> rrb.Container:
    """Return all joints in one view a quantity, and behind it a view a joint, with its limits."""
    views = [
        rrb.Tabs(
            _curves(quantity, [path(JOINTS, name, quantity) for name in names], legend=quantity == "torque"),
            rrb.Grid(*(_joint(name, quantity) for name in names), name="by joint, with limits"),
        )
        for quantity in QUANTITIES
    ]
    error = rrb.Tabs(_curves("tracking error, mrad", [path(ERROR)]), _curves("gripper", [_all(GRIPPER)]))
    return rrb.Grid(*views, error, grid_columns=2)


def _joint(name: str, quantity: str) -> rrb.View:
    return _curves(name, [path(JOINTS, name, quantity), path(JOINTS, name, quantity, "limits")], legend=False)


def _load(config: RackConfig) -> rrb.Container | rrb.View:
    if config.clock.mode == "lockstep":
        return _curves("execution, ms; no deadlines in lockstep", [_all(load.TIMES)])
    use = _curves("use of the time slice, %", [_all(load.LOAD)])
    return rrb.Tabs(use, _curves("lateness and execution, ms", [_all(load.TIMES)]))


def _ages(layout: Layout) -> rrb.Container:
    """Return the ages; a plan may stand for long, and has a scale of its own."""
    plans = [path(ages.AGES, mailbox.name) for mailbox in layout.mailboxes if mailbox.name.endswith(".plan")]
    sampled = [_all(ages.AGES), *(f"- {plan}" for plan in plans)]
    return rrb.Tabs(
        _curves("age of messages read, ms", sampled, legend=False),
        _curves("plans", plans),
        _curves("signals", [_all(SIGNALS)]),
    )


def _log() -> rrb.Container:
    columns = rrb.TextLogColumns(timeline_columns=[SIM_TIME], text_log_columns=["loglevel", "body"])
    log = rrb.TextLogView(origin=path(LOG), name="log", columns=columns)
    config = rrb.TextDocumentView(origin=path(CONFIG), name="config")
    return rrb.Tabs(log, config, _curves("recorder", [_all(RECORDER)]))


def _graph(layout: Layout, config: RackConfig) -> rrb.View:
    places = positions(layout, rack_timing(config, layout).hierarchy).values()
    columns, rows = zip(*places, strict=True)
    bounds = rrb.VisualBounds2D(
        x_range=(min(columns) - 0.6 * COLUMN, max(columns) + 0.6 * COLUMN), y_range=(min(rows) - ROW, max(rows) + ROW)
    )
    return rrb.GraphView(origin=path(HIERARCHY), name="hierarchy", visual_bounds=bounds)


def _curves(name: str, contents: list[str], legend: bool = True) -> rrb.View:
    axis = rrb.TimeAxis(link="LinkToGlobal")
    shown = rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend)
    return rrb.TimeSeriesView(origin="/", contents=contents, name=name, axis_x=axis, plot_legend=shown)


def _all(entity: str) -> str:
    return f"{path(entity)}/**"
