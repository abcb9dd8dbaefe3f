"""Writes the rows that the recorder reads as a recording for the viewer, in blocks.

View parts are functions that each show one aspect of a mailbox or task.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.segment import Segment
from rack.boards.config import RackConfig, build_rack_timing, read_stored
from rack.levels.messages import ArmState, MovePlan, MoveStatus, TaskPlan
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.systems.force.messages import ForceStatus
from rack.levels.systems.hand.messages import HandStatus
from rack.levels.systems.joint_boards.messages import DRIVING
from rack.tools.recording.occasions import Retention
from rack.tools.viewer.blueprint import RackViews, build_blueprint, write_document
from rack.tools.viewer.cell import (
    GoalWriter,
    MarkWriter,
    build_path_part,
    build_pose_part,
    write_geometry,
)
from rack.tools.viewer.curves import (
    GRIPPER,
    NOT_AS_CURVES,
    build_field_curves,
    build_hand_curves,
    build_joint_curves,
    build_task_force_curves,
)
from rack.tools.viewer.events import EventWriter, build_loss_lines
from rack.tools.viewer.levels import (
    FIRED,
    LEVELS,
    Hierarchy,
    build_error_lines,
    build_fired_lines,
    build_value_lane,
    has_state,
    list_value_lanes,
    name_lanes,
)
from rack.tools.viewer.parts import find_next_file
from rack.tools.viewer.stream import Moment, RowBlock, Stream, Timelines, ViewPart, open_recording
from rack.tools.viewer.style import write_legend, write_span
from rack.tools.viewer.timing import (
    LOAD,
    AgeWriter,
    CycleLane,
    build_load_curves,
    build_miss_lines,
    choose_task_colours,
)

BLOCK_S = 1.0
"""Simulated duration of a block. Writing 4 rows takes as long as writing 400."""


PART_S = 180.0
"""Simulated duration of a part, which is one file.

Until a file is finished, its index is kept in memory: 0.65 MB per second of the NASREM rack.
"""


class RunContext(NamedTuple):
    """Everything that the view needs to know about a run before its first row.

    Attributes:
        layout: Layout of the rack.
        text: The resolved config as TOML text.
        config: The resolved config as a record.
        cell: Cell of the arm, or None without an arm.
        events: Path of the event log.
    """

    layout: Layout
    text: str
    config: RackConfig
    cell: Cell | None
    events: Path

    @classmethod
    def from_config(cls, layout: Layout, text: str, folder: Path) -> Self:
        """Build the context of a run.

        Args:
            layout: Layout of the rack.
            text: The resolved config as TOML text.
            folder: Folder of the run.
        """
        config = read_stored(text)
        robot = config.robot
        cell = None if robot is None else build_cell(robot, config.scene, config.clock_ns)
        return cls(layout, text, config, cell, folder / "events.jsonl")


class RackWriter:
    """Writes the rows of all rings of a rack to a stream, in blocks.

    A ring contains the trace records of a task or the messages of a mailbox.
    """

    def __init__(self, stream: Stream, ran: RunContext) -> None:
        layout = ran.layout
        config = ran.config
        self._times = stream.times
        write_document(stream, ran.text, config, layout)
        rack = build_rack_timing(config, layout)
        names = name_lanes(layout, rack)
        # A status refers to moves of a plan in the same block, so plans are written before it.
        mailboxes = sorted(
            layout.mailboxes, key=lambda box: box.message == MoveStatus.message_type.name
        )
        parts_by_mailbox: dict[str, list[ViewPart]] = {
            box.name: list(_build_mailbox_parts(stream, box, names)) for box in mailboxes
        }
        marks = None
        if ran.cell is not None:
            arm = write_geometry(stream, ran.cell)
            goals = GoalWriter(stream, config.scene.bodies)
            assert config.robot is not None, "there is an arm"
            drivers = [box.writer for box in layout.mailboxes if box.message in DRIVING]
            marks = MarkWriter(stream, ran.cell, config.robot.joints, drivers, arm)
            for box in layout.mailboxes:
                if box.message in DRIVING:
                    parts_by_mailbox[box.name].append(marks.write)
                parts_by_mailbox[box.name] += _build_arm_parts(stream, box, config, ran.cell, goals)
        lockstep = config.clock.mode == "lockstep"
        # Traces measure real time, in which a tick has no fixed length in lockstep.
        tick_ns = layout.clock_ns if lockstep else config.tick_ns
        boards = [name for name in names if "." not in name]
        colours = choose_task_colours(layout, boards)
        write_legend(stream, LOAD, boards, [colours[board] for board in boards])
        self._hierarchy = Hierarchy(stream, layout, rack)
        speed = layout.clock_ns / tick_ns
        cycles = {
            task.name: CycleLane(stream, task, names[task.board], speed, lockstep)
            for task in layout.tasks
        }
        parts_by_task: dict[str, list[ViewPart]] = {
            task.name: [
                partial(self._hierarchy.write, task.name),
                cycles[task.name].write,
                *build_load_curves(
                    stream,
                    task,
                    colours[task.name],
                    layout.compute_due_ticks(task) * tick_ns,
                    lockstep,
                ),
                build_miss_lines(stream, task),
            ]
            for task in layout.tasks
        }
        # Ages are shown only for messages that are written periodically, not for messages of
        # operators and host boards and not for queues.
        periodic = [box for box in layout.timed if box.writer != CLOCK and box.protocol != "queue"]
        self._ages = {
            mailbox.name: AgeWriter(stream, mailbox, layout, colours[mailbox.writer])
            for mailbox in periodic
        }
        for mailbox, age in self._ages.items():
            parts_by_mailbox[mailbox].append(age.add_messages)
        self._parts = parts_by_task | parts_by_mailbox
        self._periods: dict[str, int] = {task.name: task.every for task in layout.tasks}
        self._periods |= {box.name: box.every for box in layout.mailboxes}
        self._last_ticks: dict[str, int] = {}  # tick of the last row of each ring
        with_states = {box.writer for box in layout.mailboxes if has_state(box)}

        def mark_lost(noticed: Moment, task: str) -> None:
            """Show a lost task in lanes, in the hierarchy and at the arm, until its next row."""
            when = cycles[task].mark_lost(noticed)
            self._hierarchy.add_change(when, task, "lost")
            if task in with_states:
                write_span(stream, when, (LEVELS, names[task], "state"), "lost")
            if marks is not None:
                marks.mark_lost(when, task)

        self._events = EventWriter(stream, ran.events, layout, names, mark_lost, marks)
        self._write_losses = build_loss_lines(stream)
        self._fastest = min(layout.tasks, key=lambda task: task.every).name

    def write(
        self, rows_by_ring: Mapping[str, np.ndarray], tick: int, lost: Mapping[str, int]
    ) -> None:
        """Write a block of rows.

        Args:
            rows_by_ring: Dictionary from task or mailbox to its rows, shape (rows,).
            tick: Tick at which the block ends. The rows include everything before this tick.
            lost: Number of rows of each ring that were lost since the start.
        """
        if (fastest := rows_by_ring.get(self._fastest)) is not None:
            self._times.add_stamps(fastest["tick"], fastest["start_ns"])
        for ring, parts in self._parts.items():
            if ring not in rows_by_ring:
                continue
            rows = rows_by_ring[ring]
            ticks = rows["tick"].astype(np.int64)
            silent = np.diff(ticks, prepend=self._last_ticks.get(ring, ticks[0]))
            self._last_ticks[ring] = int(ticks[-1])
            block = RowBlock(rows, self._times, silent > self._periods[ring])
            for write in parts:
                write(block)
        for age in self._ages.values():
            age.write_ages(tick)
        self._events.write_events(tick)
        self._hierarchy.write_changes(tick)
        self._write_losses(tick, lost)

    def write_last_events(self) -> None:
        """Write the remaining events, after all rows have been written."""
        self._events.write_events(math.inf)
        self._hierarchy.write_changes(math.inf)

    def skip_to(self, tick: int) -> None:
        """Continue at `tick` after a range of ticks that was not recorded."""
        for age in self._ages.values():
            age.skip_to(tick)


class ViewSink:
    """The recorder's sink that writes run.rrd of a rack into `folder`, in parts if the run is long.

    With a port, the recording is also served to a viewer, and has only one part, because a served
    recording cannot continue in another file. A rack with a flight recorder gets no file.
    """

    def __init__(self, segment: Segment, folder: Path, port: int | None) -> None:
        layout = segment.layout
        launch = segment.launch
        ran = RunContext.from_config(layout, segment.config, folder)
        view = build_blueprint(
            RackViews(layout, ran.config, ran.cell).build_all_views(), live=port is not None
        )
        run = f"{folder.name}-{launch.created_ns}"
        file = find_next_file(folder) if Retention.from_config(segment) is None else None
        recording = open_recording(folder.name, run, file, view, port)
        self._stream = Stream(recording, Timelines(layout.clock_ns, launch))
        self._writer = RackWriter(self._stream, ran)
        self._waiting: dict[str, list[np.ndarray]] = defaultdict(list)
        self._block = compute_block_ticks(layout)
        self._written = segment.tick
        self._folder = folder
        self._part = layout.to_ticks(PART_S)
        self._part_ends = self._written + self._part if port is None else None

    def add(self, ring: str, rows: np.ndarray) -> None:
        """Queue rows of a ring, shape (rows,), for the next block."""
        if len(rows):
            self._waiting[ring].append(rows)

    def advance(self, tick: int, lost: Mapping[str, int]) -> None:
        """Write the queued rows if they cover the duration of a block.

        Args:
            tick: Tick before which all rows have been added.
            lost: Number of lost rows of each ring.

        Raises:
            RuntimeError: The file cannot be written.
        """
        if tick - self._written >= self._block:
            # Begin a part only for rows that are written, because no viewer opens an empty file.
            if self._part_ends is not None and self._written >= self._part_ends:
                self._part_ends += self._part
                self._stream.continue_in(find_next_file(self._folder))
            self._write(tick, lost)
            self._stream.flush()

    def close(self, tick: int, lost: Mapping[str, int]) -> None:
        """Write the remaining rows and finish the file.

        Args:
            tick: Tick at which the run ended.
            lost: Number of lost rows of each ring.

        Raises:
            RuntimeError: The file cannot be written.
        """
        self._write(tick, lost)
        self._writer.write_last_events()
        self._stream.flush()
        self._stream.close()

    def _write(self, tick: int, lost: Mapping[str, int]) -> None:
        """Write the queued rows as a block that ends at `tick`."""
        self._written = tick
        waiting = self._waiting
        self._waiting = defaultdict(list)
        self._writer.write(
            {ring: np.concatenate(blocks) for ring, blocks in waiting.items()}, tick, lost
        )


def compute_block_ticks(layout: Layout) -> int:
    """Return the duration of a block in ticks."""
    return max(1, layout.to_ticks(BLOCK_S))


def _build_mailbox_parts(
    stream: Stream, mailbox: MailboxSpec, names: Mapping[str, str]
) -> Iterator[ViewPart]:
    """Yield the view parts for a mailbox that do not depend on an arm: lanes, lines and curves.

    Args:
        stream: Stream to write to.
        mailbox: The mailbox.
        names: Dictionary from task to its name in lanes.
    """
    board = mailbox.name.partition(".")[0]
    for lane in list_value_lanes(mailbox):
        yield build_value_lane(stream, names.get(board, board), lane)
    if has_state(mailbox):
        yield build_error_lines(stream, mailbox)
    if {field.name for field in mailbox.fields}.issuperset(FIRED):
        yield build_fired_lines(stream, mailbox)
    if mailbox.message not in NOT_AS_CURVES:
        yield from build_field_curves(stream, mailbox.name, mailbox.fields)


def _build_arm_parts(
    stream: Stream, mailbox: MailboxSpec, config: RackConfig, cell: Cell, goals: GoalWriter
) -> Iterator[ViewPart]:
    """Yield the view parts that show a mailbox in the 3D cell, or as curves of the arm or hand.

    Args:
        stream: Stream to write to.
        mailbox: The mailbox.
        config: Config of the rack.
        cell: Cell of the arm.
        goals: Writer of the goals. It is shared because goals need both `TaskPlan` and
            `MoveStatus`.
    """
    robot = config.robot
    assert robot is not None, "there is an arm"
    match mailbox.message:
        case ArmState.message_type.name:
            yield build_pose_part(stream, cell)
        case HandStatus.message_type.name if cell.hand is not None:
            yield from build_hand_curves(stream, robot.joints, cell.hand)
        case driving if driving in DRIVING:
            yield from build_joint_curves(stream, robot.joints, cell)
            if robot.gripper is not None:
                fields = [field for field in mailbox.fields if field.name in GRIPPER]
                yield from build_field_curves(stream, mailbox.name, fields)
        case ForceStatus.message_type.name:
            yield from build_task_force_curves(stream)
        case MovePlan.message_type.name:
            yield build_path_part(stream, cell)
        case TaskPlan.message_type.name:
            yield goals.write
        case MoveStatus.message_type.name:
            yield goals.write_status
