"""Blueprints: the initial views of the viewer, their layout, and the eye position."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.components import PlayState

from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.message import Status
from rack.boards.config import RackConfig, build_rack_timing
from rack.levels.robot.cell import Cell
from rack.levels.robot.hand import Hand
from rack.levels.systems.hand.messages import GraspStatus
from rack.levels.systems.joint_boards.messages import DRIVING
from rack.levels.systems.trajectory.messages import MotionStatus
from rack.tools.viewer import timing
from rack.tools.viewer.cell import CELL, FRAMES, compute_extent, find_floor_height
from rack.tools.viewer.curves import (
    AXES,
    BY_FINGER,
    CONTACT_UNITS,
    ERROR,
    FORCES,
    GRIPPER,
    HAND,
    JOINTS,
    NOT_AS_CURVES,
    QUANTITIES,
    SIGNALS,
    TENSIONS,
    TIPS,
    get_plotted_unit,
    has_curves,
)
from rack.tools.viewer.events import EVENTS, RACK_LANE
from rack.tools.viewer.levels import (
    HIERARCHY,
    LEVELS,
    list_value_lanes,
    name_lanes,
)
from rack.tools.viewer.stream import LOG, SIM_TIME, Stream, build_path
from rack.tools.viewer.style import GRID, LEGEND, build_lanes_view
from rack.tools.viewer.timing import BOARDS

CONFIG = "config"
LOG_COLUMNS = rrb.TextLogColumns(timeline_columns=[SIM_TIME], text_log_columns=["loglevel", "body"])
MAX_LANES = 9
"""Largest number of lanes below each other, so that none is cut off on a screen of 1080 lines."""
MAX_GRID = 4
"""Largest number of plots of signals that are shown side by side. More are shown as tabs."""
STATUS_FIELDS = [field.name for field in Status.message_type.fields]
"""Fields of every status, which are shown as lanes and log lines."""
CYCLES = "boards, cycle by cycle: R read, X process, P plan, W write"
CYCLES_S = 0.022
"""Time shown before and after the cursor in the lanes of cycles: several cycles of most boards."""
DIRECTION = np.array([0.75, -0.95, 0.55])
"""Direction from the cell to the eye: from the front right, slightly from above."""
DISTANCE = 2.05
"""Distance of the eye, relative to the radius of arm and objects.

It is large enough for a raised arm to fit into the view.
"""
TITLES = {TENSIONS: "tensions: flexors bright, extensors dim"}
"""Titles of finger plots that differ from the name of the quantity."""
ABOVE_M = 0.01
"""Height of the grid above the floor, so that the floor does not hide it."""
GRID_M = 0.25
"""Distance between lines of the grid."""


def build_blueprint(root: rrb.Container, live: bool = False) -> rrb.Blueprint:
    """Return the blueprint, the initial state of the viewer.

    Args:
        root: Container of all views.
        live: Whether the time cursor follows the newest data.
    """
    play = PlayState.Following if live else PlayState.Paused
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=SIM_TIME, play_state=play),
        auto_views=False,
        auto_layout=False,
    )


def build_common_view(racks: Mapping[str, RackViews], what: str) -> rrb.Container:
    """Return the view of several racks that ran together, or of two runs of one rack.

    The first tab shows all of them side by side above a common log. Each further tab shows one.

    Args:
        racks: Dictionary from the name of each rack or run to its views.
        what: Word for them in titles, "racks" or "runs".
    """
    logs = [f"{build_path(LOG)}/**", *(views.build_query(LOG) for views in racks.values())]
    title = f"log of all {what}"
    log = rrb.TextLogView(origin="/", contents=logs, name=title, columns=LOG_COLUMNS)
    columns = rrb.Horizontal(*(views.build_column(rack) for rack, views in racks.items()))
    first_tab = rrb.Vertical(columns, log, row_shares=[4, 1], name=f"all {what}")
    tabs = (views.build_all_views(rack) for rack, views in racks.items())
    return rrb.Tabs(first_tab, *tabs, active_tab=0)


class RackViews:
    """Builds the views of one rack: its cell in 3D, curves, lanes and log.

    A lane shows the states of a board or level over time as coloured spans. All entities of the
    rack in the recording are below the path `root`.
    """

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
        self._timing = build_rack_timing(config, layout)
        self._names = name_lanes(layout, self._timing)
        self._boards = [name for name in self._names if "." not in name]

    def build_path(self, *entity: str) -> str:
        """Return the path of an entity of this rack in the recording."""
        return build_path(*self._root, *entity)

    def build_query(self, *entity: str) -> str:
        """Return a query that selects an entity of this rack and everything below it."""
        return f"{self.build_path(*entity)}/**"

    def build_all_views(self, name: str | None = None) -> rrb.Container:
        """Return a container, titled `name`, with all views of the rack."""
        below = rrb.Tabs(
            self._build_level_lanes("levels, whole run"),
            self._build_event_lanes(),
            rrb.GraphView(origin=self.build_path(HIERARCHY), name="hierarchy"),
            active_tab=0,
        )
        left: rrb.Container = below
        if self._cell is not None:
            left = rrb.Vertical(self._build_scene(self._cell, "cell"), below, row_shares=[11, 9])
        curves: rrb.Container | rrb.View
        if self._hand is not None:
            curves = self._build_finger_plots(self._hand)
        elif self._cell is not None and self._joints:
            curves = self._build_arm_plots(self._cell)
        else:
            curves = self._build_unit_plots("signals", self._layout.mailboxes)
        right = rrb.Vertical(
            curves,
            self._build_cycle_lanes(),
            rrb.Horizontal(
                self._build_load_plots(),
                self._build_age_plots(),
                self._build_legend(timing.LOAD, "tasks", self._boards),
                rrb.Tabs(
                    rrb.TextLogView(origin=self.build_path(LOG), name="log", columns=LOG_COLUMNS),
                    rrb.TextDocumentView(origin=self.build_path(CONFIG), name="config"),
                ),
                column_shares=[4, 4, 2, 8],
            ),
            row_shares=[4, 5, 3],
        )
        return rrb.Horizontal(left, right, column_shares=[2, 3], name=name)

    def build_column(self, name: str) -> rrb.Container | rrb.View:
        """Return a column for a view of several racks: the cell, if any, above the level lanes."""
        levels = self._build_level_lanes(f"{name}: levels")
        if self._cell is None:
            return levels
        return rrb.Vertical(self._build_scene(self._cell, name), levels, row_shares=[5, 4])

    def _build_level_lanes(self, name: str) -> rrb.Container | rrb.View:
        """Return views of the states, moves and commands of all levels in the whole run."""
        lanes: list[tuple[list[str], int]] = []
        others = {box.name.partition(".")[0] for box in self._layout.mailboxes} - {*self._boards}
        for board in (*self._boards, *sorted(others)):
            boxes = [box for box in self._layout.mailboxes if box.name.startswith(f"{board}.")]
            count = sum(len([*list_value_lanes(box)]) for box in boxes)
            lanes.append(([self.build_query(LEVELS, self._names.get(board, board))], count))
        return _build_lane_columns(name, lanes)

    def _build_event_lanes(self) -> rrb.Container | rrb.View:
        """Return views of the events of all boards in the whole run."""
        names = (*self._names.values(), *self._config.host, "clock", RACK_LANE)
        lanes = [([self.build_query(EVENTS, name)], 1) for name in names]
        return _build_lane_columns("events", lanes)

    def _build_cycle_lanes(self) -> rrb.Container | rrb.View:
        """Return views of the cycles of all tasks around the time cursor."""
        tasks = [task.board for task in self._layout.tasks]
        lanes = [
            ([self.build_query(BOARDS, self._names[board])], tasks.count(board))
            for board in self._boards
        ]
        return _build_lane_columns(CYCLES, lanes, CYCLES_S)

    def _build_scene(self, cell: Cell, name: str) -> rrb.View:
        """Return the 3D view of the cell with the title `name`."""
        # From the eye, arm and objects fill the view.
        centre, radius = compute_extent(cell)
        eye = centre + DISTANCE * radius * DIRECTION / np.linalg.norm(DIRECTION)
        plane = rr.components.Plane3D((0.0, 0.0, 1.0), find_floor_height(cell) + ABOVE_M)
        return rrb.Spatial3DView(
            origin=self.build_path(CELL),
            contents=[self.build_query(CELL), self.build_query(FRAMES)],
            name=name,
            eye_controls=rrb.EyeControls3D(
                position=eye.tolist(), look_target=centre.tolist(), eye_up=(0, 0, 1)
            ),
            line_grid=rrb.LineGrid3D(visible=True, plane=plane, spacing=GRID_M, color=GRID),
        )

    def _build_arm_plots(self, cell: Cell) -> rrb.Container:
        """Return the plots of the arm.

        Each quantity has one plot with all joints and, in a second tab, one plot per joint with
        limits. Own signals, requests, forces, tracking error and gripper follow in further tabs.
        """
        views = [
            rrb.Tabs(
                self._plot(
                    f"{quantity}, {unit}", *((JOINTS, name, quantity) for name in self._joints)
                ),
                rrb.Grid(
                    *(
                        self._plot(
                            f"{name}, {unit}",
                            (JOINTS, name, quantity),
                            (JOINTS, name, quantity, "limits"),
                        )
                        for name in self._joints
                    ),
                    name="by joint, with limits",
                ),
            )
            for quantity, unit in QUANTITIES.items()
        ]
        own = self._list_own_mailboxes()
        other_plots = rrb.Tabs(
            *([self._build_unit_plots("own signals", own)] if own else []),
            *self._list_other_plots(cell),
            active_tab=0,
        )
        legend = self._build_legend(JOINTS, "joints", self._joints)
        return rrb.Horizontal(
            rrb.Grid(*views, other_plots, grid_columns=2), legend, column_shares=[9, 1]
        )

    def _list_other_plots(self, cell: Cell) -> Iterator[rrb.Container | rrb.View]:
        """Yield the plots of requests, forces, tracking error and gripper that the rack has."""
        for box in self._layout.mailboxes:
            if box.message == MotionStatus.message_type.name:
                signals = (SIGNALS, box.name)
                yield rrb.Horizontal(
                    self._plot("taken and done", (*signals, "taken"), (*signals, "done")),
                    self._plot("from moving goal, m", (*signals, "astray")),
                    name="queue and moving goal",
                )
        if cell.wrist is not None:
            yield self._plot("force along z, wanted and exerted, N", (FORCES, "z"))
            for what, unit in CONTACT_UNITS.items():
                axes = [(FORCES, axis) for axis in AXES if AXES[axis] == unit]
                yield self._plot(f"{what} wanted and exerted, {unit}", *axes)
        yield self._plot("tracking error, mrad", (ERROR,))
        if cell.gripper is not None:
            for box in self._layout.mailboxes:
                for field in box.fields:
                    if box.message in DRIVING and field.name in GRIPPER:
                        title = f"{field.name}, {field.unit}"
                        yield self._plot(title, (SIGNALS, box.name, field.name))

    def _plot(self, title: str, *entities: tuple[str, ...]) -> rrb.View:
        """Return a plot of the curves of some entities of this rack."""
        return _build_plot(title, [self.build_path(*entity) for entity in entities])

    def _build_legend(self, what: str, name: str, names: Sequence[str]) -> rrb.View:
        """Return a view, with a title, of the legend `what` that `write_legend` wrote."""
        return rrb.GraphView(origin=self.build_path(LEGEND, what), name=name)

    def _build_finger_plots(self, hand: Hand) -> rrb.Container:
        """Return the plots of a hand.

        Each tab has one plot per finger, of tensions, joints or forces. Beside the tabs are plots
        of the forces on all fingertips, and of weight and pull of a grasped object.
        """
        tabs = [
            rrb.Grid(
                *(self._plot(f"{finger}, {unit}", (HAND, finger, kind)) for finger in hand.names),
                grid_columns=2,
                name=TITLES.get(kind, kind),
            )
            for kind, unit in BY_FINGER.items()
        ]
        tips = self._plot("force on the tips, N", TIPS)
        pulls = [
            self._plot("weight and pull, N", (SIGNALS, box.name, "load"))
            for box in self._layout.mailboxes
            if box.message == GraspStatus.message_type.name
        ]
        return rrb.Horizontal(
            rrb.Tabs(*tabs, active_tab=0),
            rrb.Vertical(tips, *pulls),
            self._build_legend(HAND, "fingers", hand.names),
            column_shares=[5, 4, 1],
        )

    def _list_own_mailboxes(self) -> list[MailboxSpec]:
        """Return the mailboxes of the user's levels that are shown as signals."""
        own = {
            task.name for task in self._config.list_tasks() if not task.target.startswith("rack.")
        }
        boxes = self._layout.mailboxes
        return [box for box in boxes if box.writer in own and box.message not in NOT_AS_CURVES]

    def _build_unit_plots(
        self, name: str, mailboxes: Sequence[MailboxSpec]
    ) -> rrb.Container | rrb.View:
        """Return plots of the numbers in messages, one for each unit, with legends.

        Args:
            name: Title of the view, and beginning of the titles of plots.
            mailboxes: The mailboxes.
        """
        by_unit: dict[str, list[str]] = {}
        for box in mailboxes:
            for field in filter(has_curves, box.fields):
                if field.name not in STATUS_FIELDS and not field.values:
                    paths = by_unit.setdefault(get_plotted_unit(field), [])
                    paths.append(self.build_path(SIGNALS, box.name, field.name))
        plots = [
            _build_plot(f"{name}, {unit}" if unit else name, paths, True)
            for unit, paths in by_unit.items()
        ]
        if len(plots) == 1:
            return plots[0]
        return (rrb.Grid if len(plots) <= MAX_GRID else rrb.Tabs)(*plots, name=name)

    def _build_load_plots(self) -> rrb.Container | rrb.View:
        """Return plots of the used parts of time slices, and of lateness and execution times."""
        is_lockstep = self._config.clock.mode == "lockstep"
        titles = ("execution, % of cycle", "execution, ms")
        if not is_lockstep:
            titles = ("slice used, %", "late and execution, ms")
        groups = zip(titles, (timing.LOAD, timing.TIMES), strict=True)
        plots = [_build_plot(title, [self.build_query(group)]) for title, group in groups]
        return rrb.Tabs(*plots, active_tab=0)

    def _build_age_plots(self) -> rrb.Container:
        """Return tabs with plots of message ages, plan ages and all signals.

        Plans have a separate plot, because they may be much older than other messages.
        """
        boxes = [mailbox.name for mailbox in self._layout.mailboxes]
        plans = [self.build_path(timing.AGES, name) for name in boxes if name.endswith(".plan")]
        sampled = [self.build_query(timing.AGES), *(f"- {plan}" for plan in plans)]
        return rrb.Tabs(
            _build_plot("message age, ms", sampled),
            _build_plot("plan age, ms", plans),
            self._build_unit_plots("signals", self._layout.mailboxes),
        )


def _build_lane_columns(
    name: str, lanes: Sequence[tuple[list[str], int]], around_s: float | None = None
) -> rrb.Container | rrb.View:
    """Return a view of lanes, or several side by side if one could not show all of them.

    Args:
        name: Title of the views.
        lanes: Queries and largest number of lanes of each board, in the order of the lanes.
        around_s: See `build_lanes_view`.
    """
    total = sum(count for _, count in lanes)
    columns = max(1, -(-total // MAX_LANES))
    contents: list[list[str]] = [[]]
    shown = 0
    for queries, count in lanes:
        # Begin a column where its share of the lanes is reached, but keep each board together.
        if shown + count / 2 > len(contents) * total / columns:
            contents.append([])
        contents[-1] += queries
        shown += count
    views = [build_lanes_view(name, queries, around_s) for queries in contents]
    return views[0] if len(views) == 1 else rrb.Horizontal(*views, name=name)


def _build_plot(
    name: str,
    contents: list[str],
    legend: bool = False,
) -> rrb.View:
    """Return a plot of curves.

    Args:
        name: Title of the plot.
        contents: Queries for its entities.
        legend: Whether to show a legend.
    """
    return rrb.TimeSeriesView(
        contents=contents,
        name=name,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
    )


def write_document(stream: Stream, text: str, config: RackConfig, layout: Layout) -> None:
    """Log the resolved config and the properties of the run.

    Args:
        stream: Stream to write to.
        text: The resolved config as text.
        config: The same config as a record.
        layout: Layout of the rack.
    """
    stream.log_static((CONFIG,), rr.TextDocument(f"```toml\n{text}```", media_type="text/markdown"))
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
    stream.log_property("run", values)
