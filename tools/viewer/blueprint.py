"""The first view of a run: the blueprint of all views, the place of the eye, and the config as a document."""

from __future__ import annotations

import platform
from collections.abc import Sequence

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rack.backplane.layout import Layout
from rack.boards.config import RackConfig, rack_timing
from rack.levels.joint_messages import DRIVING
from rack.levels.robot.cell import Cell
from rack.tools.viewer import timing
from rack.tools.viewer.cell import CELL, COLLISION, FRAMES
from rack.tools.viewer.curves import ERROR, GRIPPER, JOINTS, QUANTITIES, SIGNALS
from rack.tools.viewer.events import EVENTS, RECORDER
from rack.tools.viewer.levels import COLUMN, HIERARCHY, LEVELS, LOG, ROW, positions
from rack.tools.viewer.stream import SIM_TIME, Stream, path
from rack.tools.viewer.style import lanes_view
from rack.tools.viewer.timing import BOARDS

CONFIG = "config"
CYCLES_S = 0.022
"""Time before and after the cursor in the Gantt lanes: some cycles of fast and of slower boards."""
DIRECTION = np.array([0.75, -0.95, 0.55])
"""From the cell to the eye: from the front right, slightly above."""
DISTANCE = 1.75
"""In radii of the cell, so that it fills the view, including a raised arm."""
ENDLESS = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)


def blueprint(layout: Layout, config: RackConfig, cell: Cell | None, live: bool) -> rrb.Blueprint:
    """Return the blueprint of a rack: its cell in 3D, curves, lanes, log; `live` follows the newest data."""
    has_arm = cell is not None and any(mailbox.message in DRIVING for mailbox in layout.mailboxes)
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
    shown, eye = [_all(CELL), f"- {path(CELL, COLLISION)}/**", _all(FRAMES)], eye_on(cell)
    return rrb.Spatial3DView(origin=path(CELL), contents=shown, name="cell", eye_controls=eye, line_grid=False)


def _joints(names: Sequence[str]) -> rrb.Container:
    """Return a view of all joints for each quantity, and in a second tab one of each joint with its limits."""
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
        return _curves("execution, ms; no deadlines in lockstep", [_all(timing.TIMES)])
    use = _curves("use of the time slice, %", [_all(timing.LOAD)])
    return rrb.Tabs(use, _curves("lateness and execution, ms", [_all(timing.TIMES)]))


def _ages(layout: Layout) -> rrb.Container:
    """Return the ages; plans, which may be old, have their own scale."""
    plans = [path(timing.AGES, mailbox.name) for mailbox in layout.mailboxes if mailbox.name.endswith(".plan")]
    sampled = [_all(timing.AGES), *(f"- {plan}" for plan in plans)]
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
    places = positions(layout, rack_timing(config, layout)).values()
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


def eye_on(cell: Cell) -> rrb.EyeControls3D:
    """Return the place from which the eye sees all of a cell at its start, except the ground."""
    model, data = cell.model, cell.start()
    geoms = np.flatnonzero(~np.isin(model.geom_type, ENDLESS))
    radii = model.geom_rbound[geoms, None]
    low = (data.geom_xpos[geoms] - radii).min(axis=0, initial=np.inf)
    high = (data.geom_xpos[geoms] + radii).max(axis=0, initial=-np.inf)
    if not np.isfinite([low, high]).all():
        low, high = model.stat.center - model.stat.extent, model.stat.center + model.stat.extent
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    position = centre + DISTANCE * radius * DIRECTION / np.linalg.norm(DIRECTION)
    return rrb.EyeControls3D(position=position.tolist(), look_target=centre.tolist(), eye_up=(0, 0, 1))


def write_document(stream: Stream, text: str, config: RackConfig, layout: Layout) -> None:
    """Log the resolved config, and the properties of the run."""
    stream.static((CONFIG,), rr.TextDocument(f"```toml\n{text}```", media_type="text/markdown"))
    values = rr.AnyValues(
        rack=layout.rack,
        mode=config.clock.mode,
        speed=config.clock.speed,
        clock_ms=layout.clock_ns * 1e-6,
        tasks=[task.name for task in layout.tasks],
        robot=str(config.robot.model.stem) if config.robot else "none",
        machine=platform.platform(),
    )
    stream.property("run", values)
