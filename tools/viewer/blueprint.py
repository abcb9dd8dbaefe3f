"""The first view of one run or several: the blueprint of all views, the place of the eye, the
config as a document."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rack.backplane.layout import Layout
from rack.boards.config import RackConfig, rack_timing
from rack.levels.robot.cell import Cell
from rack.levels.robot.hand import Hand
from rack.levels.systems.joint_boards.messages import DRIVING
from rack.tools.viewer import timing
from rack.tools.viewer.cell import CELL, COLLISION, FRAMES
from rack.tools.viewer.curves import ERROR, GRIPPER, JOINTS, QUANTITIES, SIGNALS
from rack.tools.viewer.events import EVENTS, RECORDER
from rack.tools.viewer.forces import AXES, CONTACT, FORCES, TASK
from rack.tools.viewer.hand import BY_FINGER, HAND, TIPS
from rack.tools.viewer.levels import COLUMN, HIERARCHY, LEVELS, ROW, positions
from rack.tools.viewer.stream import LOG, SIM_TIME, Stream, path
from rack.tools.viewer.style import lanes_view
from rack.tools.viewer.timing import BOARDS

CONFIG = "config"
LOG_COLUMNS = rrb.TextLogColumns(timeline_columns=[SIM_TIME], text_log_columns=["loglevel", "body"])
CYCLES_S = 0.022
"""Time before and after the cursor in the Gantt lanes: some cycles of fast and of slower boards."""
DIRECTION = np.array([0.75, -0.95, 0.55])
"""From the cell to the eye: from the front right, slightly above."""
DISTANCE = 1.75
"""In radii of the cell, so that it fills the view, including a raised arm."""
ENDLESS = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)


def blueprint(root: rrb.Container, live: bool = False) -> rrb.Blueprint:
    """Return the blueprint of a view; `live` follows the newest data."""
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed", timeline=SIM_TIME, play_state="following" if live else "paused"
        ),
        auto_views=False,
        auto_layout=False,
    )


def together(racks: Mapping[str, RackViews]) -> rrb.Container:
    """Return the view of several racks, by name: all at once, and in further tabs each by itself.

    All at once are a column for each rack, its cell above what its levels do, and below them the
    log of all.
    """
    columns = rrb.Horizontal(*(views.column(name) for name, views in racks.items()))
    logs = [f"{path(LOG)}/**", *(views.all(LOG) for views in racks.values())]
    log = rrb.TextLogView(origin="/", contents=logs, name="log of all racks", columns=LOG_COLUMNS)
    shown = rrb.Vertical(columns, log, row_shares=[4, 1], name="all racks")
    return rrb.Tabs(shown, *(views.everything(name) for name, views in racks.items()), active_tab=0)


class RackViews:
    """The views of one rack: its cell in 3D, curves, lanes, log. Its entities are below `root`."""

    def __init__(
        self, layout: Layout, config: RackConfig, cell: Cell | None, root: Sequence[str] = ()
    ) -> None:
        self._layout = layout
        self._config = config
        self._cell = cell
        self._root = root
        has_arm = cell is not None and any(
            mailbox.message in DRIVING for mailbox in layout.mailboxes
        )
        self._hand = None if cell is None else cell.hand
        self._joints = config.robot.joints if config.robot is not None and has_arm else ()

    def path(self, *entity: str) -> str:
        """Return the path of an entity."""
        return path(*self._root, *entity)

    def all(self, *entity: str) -> str:
        """Return the query for an entity and all below it."""
        return f"{self.path(*entity)}/**"

    def everything(self, name: str | None = None) -> rrb.Container:
        """Return all views."""
        doing = lanes_view("levels and events, whole run", [self.all(EVENTS), self.all(LEVELS)])
        below = rrb.Horizontal(doing, self._graph(), column_shares=[3, 2])
        left: rrb.Container = below
        if self._cell is not None:
            left = rrb.Vertical(self._scene(self._cell, "cell"), below, row_shares=[11, 9])
        curves: rrb.Container | rrb.View
        if self._hand is not None:
            curves = self._fingers(self._hand)
        elif self._joints:
            curves = self._arm()
        else:
            curves = self._signals()
        right = rrb.Vertical(
            curves,
            lanes_view("boards, cycle by cycle", [self.all(BOARDS)], CYCLES_S),
            rrb.Horizontal(self._load(), self._ages(), self._log(), column_shares=[3, 3, 4]),
            row_shares=[4, 5, 3],
        )
        return rrb.Horizontal(left, right, column_shares=[2, 3], name=name)

    def column(self, name: str) -> rrb.Container | rrb.View:
        """Return the cell, if there is one, above what the levels do."""
        levels = lanes_view(f"{name}: levels", [self.all(LEVELS)])
        if self._cell is None:
            return levels
        return rrb.Vertical(self._scene(self._cell, name), levels, row_shares=[5, 4])

    def _scene(self, cell: Cell, name: str) -> rrb.View:
        """Return the view of the cell."""
        return rrb.Spatial3DView(
            origin=self.path(CELL),
            contents=[self.all(CELL), f"- {self.all(CELL, COLLISION)}", self.all(FRAMES)],
            name=name,
            eye_controls=eye_on(cell),
            line_grid=False,
        )

    def _arm(self) -> rrb.Container:
        """Return a view of all joints for each quantity, and in a second tab one of each joint with
        its limits."""
        views = [
            rrb.Tabs(
                _curves(
                    quantity,
                    [self.path(JOINTS, name, quantity) for name in self._joints],
                    legend=quantity == "torque",
                ),
                rrb.Grid(
                    *(self._joint(name, quantity) for name in self._joints),
                    name="by joint, with limits",
                ),
            )
            for quantity in QUANTITIES
        ]
        error = _curves("tracking error, mrad", [self.path(ERROR)])
        gripper = _curves("gripper", [self.all(GRIPPER)])
        return rrb.Grid(*views, rrb.Tabs(*self._forces(), error, gripper), grid_columns=2)

    def _forces(self) -> list[rrb.View]:
        """Return the views of forces, of an arm or hand that senses them."""
        if self._cell is None or self._cell.wrist is None:
            return []
        views = [
            _curves(
                f"{what} wanted and exerted, {unit}",
                [self.path(FORCES, TASK, axis) for axis in AXES if AXES[axis] == unit],
            )
            for what, unit in (("force", "N"), ("torque", "N m"))
        ]
        return [*views, _curves("contact, with limits", [self.all(FORCES, CONTACT)])]

    def _fingers(self, hand: Hand) -> rrb.Container:
        """Return a view of every finger for tensions, joints and forces, each kind in a tab, and
        one of all tips."""
        tabs = [
            rrb.Grid(
                *(
                    _curves(f"{finger}, {unit}", [self.path(HAND, finger, kind)], legend=False)
                    for finger in hand.names
                ),
                grid_columns=2,
                name=kind,
            )
            for kind, unit in BY_FINGER.items()
        ]
        return rrb.Horizontal(
            rrb.Tabs(*tabs, active_tab=0), _curves("force on the tips, N", [self.path(*TIPS)])
        )

    def _joint(self, name: str, quantity: str) -> rrb.View:
        shown = [self.path(JOINTS, name, quantity), self.path(JOINTS, name, quantity, "limits")]
        return _curves(name, shown, legend=False)

    def _signals(self) -> rrb.View:
        return _curves("signals", [self.all(SIGNALS)])

    def _load(self) -> rrb.Container | rrb.View:
        times = self.all(timing.TIMES)
        if self._config.clock.mode == "lockstep":
            return _curves("execution, ms; no deadlines in lockstep", [times])
        use = _curves("use of the time slice, %", [self.all(timing.LOAD)])
        return rrb.Tabs(use, _curves("lateness and execution, ms", [times]))

    def _ages(self) -> rrb.Container:
        """Return the ages; plans, which may be old, have their own scale."""
        boxes = [mailbox.name for mailbox in self._layout.mailboxes]
        plans = [self.path(timing.AGES, name) for name in boxes if name.endswith(".plan")]
        sampled = [self.all(timing.AGES), *(f"- {plan}" for plan in plans)]
        return rrb.Tabs(
            _curves("age of messages read, ms", sampled, legend=False),
            _curves("plans", plans),
            self._signals(),
        )

    def _log(self) -> rrb.Container:
        log = rrb.TextLogView(origin=self.path(LOG), name="log", columns=LOG_COLUMNS)
        config = rrb.TextDocumentView(origin=self.path(CONFIG), name="config")
        return rrb.Tabs(log, config, _curves("recorder", [self.all(RECORDER)]))

    def _graph(self) -> rrb.View:
        places = positions(self._layout, rack_timing(self._config, self._layout)).values()
        columns, rows = zip(*places, strict=True)
        bounds = rrb.VisualBounds2D(
            x_range=(min(columns) - 0.6 * COLUMN, max(columns) + 0.6 * COLUMN),
            y_range=(min(rows) - ROW, max(rows) + ROW),
        )
        return rrb.GraphView(origin=self.path(HIERARCHY), name="hierarchy", visual_bounds=bounds)


def _curves(name: str, contents: list[str], legend: bool = True) -> rrb.View:
    axis = rrb.TimeAxis(link="LinkToGlobal")
    shown = rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend)
    return rrb.TimeSeriesView(
        origin="/", contents=contents, name=name, axis_x=axis, plot_legend=shown
    )


def eye_on(cell: Cell) -> rrb.EyeControls3D:
    """Return the place from which the eye sees all of a cell at its start, except the ground."""
    model = cell.model
    data = cell.start()
    geoms = np.flatnonzero(~np.isin(model.geom_type, ENDLESS))
    radii = model.geom_rbound[geoms, None]
    low = (data.geom_xpos[geoms] - radii).min(axis=0, initial=np.inf)
    high = (data.geom_xpos[geoms] + radii).max(axis=0, initial=-np.inf)
    if not np.isfinite([low, high]).all():
        low = model.stat.center - model.stat.extent
        high = model.stat.center + model.stat.extent
    centre = (low + high) / 2
    radius = float(np.linalg.norm(high - low)) / 2
    position = centre + DISTANCE * radius * DIRECTION / np.linalg.norm(DIRECTION)
    return rrb.EyeControls3D(
        position=position.tolist(), look_target=centre.tolist(), eye_up=(0, 0, 1)
    )


def write_document(stream: Stream, text: str, config: RackConfig, layout: Layout) -> None:
    """Log the resolved config, and the properties of the run."""
    stream.static((CONFIG,), rr.TextDocument(f"```toml\n{text}```", media_type="text/markdown"))
    robot = config.robot.model.stem if config.robot else "none"
    values = rr.AnyValues(
        rack=layout.rack,
        mode=config.clock.mode,
        speed=config.clock.speed,
        clock_ms=layout.clock_ns * 1e-6,
        tasks=[task.name for task in layout.tasks],
        robot=robot,
        machine=platform.platform(),
    )
    stream.property("run", values)
