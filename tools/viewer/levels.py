"""Shows the levels: lanes for states and moves, log lines for errors, and a graph."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from enum import IntEnum
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import rerun as rr

from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.message import Message, State, decode_text
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.trace_times import find_missed_cycles
from rack.levels.messages import ArmState, MoveStatus, Verb
from rack.levels.systems.force.messages import Mode, ServerStatus
from rack.levels.systems.hand.messages import STREAMED_DOWN, GraspKind, GraspStatus
from rack.levels.systems.joint_boards.messages import STREAMED
from rack.levels.systems.trajectory.messages import MotionStatus
from rack.tools.viewer.stream import Moment, RowBlock, Stream, ViewPart, build_change_finder
from rack.tools.viewer.style import STATES, pack_colours, style_lane, write_spans

LEVELS = "levels"
HIERARCHY = "hierarchy"
ROW = 45.0
COLUMN = 110.0
"""Vertical and horizontal distance of nodes in the units of the graph. A letter has about 7."""
MAX_ROW_BOARDS = 3
"""Largest number of boards in a row of the graph, so that the text is large enough to read."""
FIRED = ["table", "row", "fired", "in_state"]
"""Fields of a status that say which row of a state table fires."""


class ValueLane(NamedTuple):
    """A lane that shows a value in the messages of a level.

    Attributes:
        name: Name of the lane.
        fields: Field with the value. For several fields, the value is a tuple.
        format_value: Function that returns the text for a value.
    """

    name: str
    fields: str | list[str]
    format_value: Callable[[Any], str]


def build_value_lane(stream: Stream, board: str, lane: ValueLane) -> ViewPart:
    """Return the view part that shows a value in a level's messages as a lane.

    Args:
        stream: Stream to write to.
        board: Name of the board in lanes.
        lane: The lane.
    """
    entity = (LEVELS, board, lane.name)
    if lane.fields == "state":
        style_lane(stream, entity, STATES)
    changed_rows = build_change_finder()

    def write(block: RowBlock) -> None:
        """Write the text for the value at every row in which the value changes."""
        values = block.messages[lane.fields]
        # After a silence, the value ends the span "lost" even if it is the same as before.
        rows = np.union1d(changed_rows(values), np.flatnonzero(block.resumed))
        if len(rows):
            names = [lane.format_value(value) for value in values[rows].tolist()]
            write_spans(stream, entity, block.build_time_columns(rows), names)

    return write


def format_serial(serial: int) -> str:
    """Format the number of a command or motion request. Returns "" for 0, which means none."""
    return str(serial) if serial else ""


def format_enum(kind: type[IntEnum], number: int) -> str:
    """Return the name of an enum member with this number, in lower case and with spaces."""
    return kind(number).name.lower().replace("_", " ")


VALUE_LANES: tuple[tuple[type[Message], ValueLane], ...] = (
    (
        MoveStatus,
        # A move of serial 0 means no move.
        ValueLane(
            "move", ["current", "verb"], lambda move: format_enum(Verb, move[1]) if move[0] else ""
        ),
    ),
    (MotionStatus, ValueLane("request", "current", format_serial)),
    (ServerStatus, ValueLane("request", "current", format_serial)),
    (
        GraspStatus,
        ValueLane(
            "step",
            ["step", "kind"],
            lambda step: f"{step[0] + 1} {format_enum(GraspKind, step[1])}",
        ),
    ),
    (ServerStatus, ValueLane("mode", "mode", partial(format_enum, Mode))),
)
"""Lanes for messages of certain classes."""


def list_value_lanes(mailbox: MailboxSpec) -> Iterator[ValueLane]:
    """Yield the lanes that show values in the messages of a mailbox."""
    names = {field.name for field in mailbox.fields}
    port = mailbox.name.partition(".")[2]
    kind = mailbox.message
    if has_state(mailbox):
        # An adapter also writes the statuses of other racks' levels, one port for each.
        name = "state" if port == "status" else port
        yield ValueLane(name, "state", partial(format_enum, State))
    elif port == "command" and "id" in names and kind not in (*STREAMED, *STREAMED_DOWN):
        yield ValueLane(port, "id", format_serial)
    if names.issuperset(FIRED):
        yield ValueLane("row", FIRED[1:3], lambda row: f"{row[0]} {decode_text(row[1])}")
    yield from (lane for message, lane in VALUE_LANES if kind == message.message_type.name)


def has_state(mailbox: MailboxSpec) -> bool:
    """Return whether the messages of a mailbox contain the state of a level."""
    names = {field.name for field in mailbox.fields}
    return {"state", "error", "reason"} <= names and mailbox.message != ArmState.message_type.name


def build_error_lines(stream: Stream, mailbox: MailboxSpec) -> ViewPart:
    """Return the view part that writes a log line for each new error of a level."""
    board = mailbox.name.partition(".")[0]
    changed_rows = build_change_finder()

    def write(block: RowBlock) -> None:
        """Write a log line for each new error in a block of messages."""
        messages = block.messages
        for row in changed_rows(messages["error"]):
            if error := messages["error"][row]:
                reason = decode_text(messages["reason"][row])
                text = f"{board}: {reason or f'error {error}'}"
                stream.log_line(block.find_moment(row), "levels", text, "ERROR")

    return write


def build_fired_lines(stream: Stream, mailbox: MailboxSpec) -> ViewPart:
    """Return the view part that writes a log line for each row of a state table that fires."""
    board = mailbox.name.partition(".")[0]
    changed_rows = build_change_finder()

    def write(block: RowBlock) -> None:
        """Write a log line whenever the fired row changes."""
        for row_index in changed_rows(block.messages[FIRED]):
            table, row, fired, state = block.messages[FIRED][row_index]
            now = f"now in '{decode_text(state)}', table {decode_text(table)}"
            text = f"{board}: row {row} '{decode_text(fired)}', {now}"
            level = "INFO" if row else "ERROR"
            stream.log_line(block.find_moment(row_index), "rows", text, level)

    return write


class Hierarchy:
    """Writes the tasks as nodes of a graph, coloured by state.

    Higher levels are drawn above lower levels, and boards outside the hierarchy to their left.
    Edges lead from each level to the levels below it, and from each planner to its board. Changes
    of state are collected until `write_changes` writes them. A planner's trace record comes only at
    the end of its plan, so changes are written when that time has passed.
    """

    def __init__(self, stream: Stream, layout: Layout, rack: RackTiming) -> None:
        self._stream = stream
        self._tasks = [task.name for task in layout.tasks]
        self._states = dict.fromkeys(self._tasks, "idle")  # the newest states
        self._shown = dict(self._states)  # the states that the graph shows
        self._positions = compute_positions(layout, rack)
        self._changes: list[tuple[Moment, str, str]] = []
        self._longest_slice = max(task.slice for task in layout.tasks)
        downward = [(upper, board.name) for board in rack.boards.values() for upper in board.above]
        plans = [(task.name, task.board) for task in layout.tasks if task.role == "planner"]
        stream.log_static((HIERARCHY,), rr.GraphEdges(downward + plans, graph_type="directed"))
        self._write_graph(stream.times.estimate_moment(0))

    def write(self, task: str, block: RowBlock) -> None:
        """Collect the changes of a task's state from a block of its trace records."""
        states = np.array([state.name.lower() for state in State] + ["missed"])
        # A missed cycle counts as a state.
        names = states[np.where(find_missed_cycles(block.rows), -1, block.rows["state"])]
        before = np.concatenate(([self._states[task]], names[:-1]))
        for row in np.flatnonzero((names != before) | block.resumed):
            self.add_change(block.find_moment(row), task, str(names[row]))

    def add_change(self, when: Moment, task: str, state: str) -> None:
        """Add a change of state that `write_changes` will write."""
        self._changes.append((when, task, state))
        self._states[task] = state

    def write_changes(self, tick: float) -> None:
        """Write the changes of state that precede any whose records may come after `tick`.

        They are written earliest first. Infinity writes all collected changes.
        """
        self._changes.sort()
        while self._changes and self._changes[0][0].tick < tick - self._longest_slice:
            when, task, state = self._changes.pop(0)
            self._shown[task] = state
            self._write_graph(when)

    def _write_graph(self, when: Moment) -> None:
        """Write the graph with the current colours."""
        nodes = rr.GraphNodes(
            self._tasks,
            positions=[self._positions[task] for task in self._tasks],
            colors=pack_colours(STATES[self._shown[task]] for task in self._tasks),
            # A planner's label omits the board, because its node is next to the board's node.
            labels=[task.partition(".")[2] or task for task in self._tasks],
        )
        self._stream.log_at(when, (HIERARCHY,), nodes)


def name_lanes(layout: Layout, rack: RackTiming) -> dict[str, str]:
    """Return a dictionary from task to its name in lanes, in the order of the lanes.

    The viewer sorts lanes by name, so the name begins with the number of the board: those of the
    hierarchy from the top down, then the others. Each executor is above its planner.
    """
    ranked = [board for rank in rack.ranks for board in rank]
    boards = list(dict.fromkeys([*ranked, *(task.board for task in layout.tasks)])).index
    tasks = sorted(layout.tasks, key=lambda task: boards(task.board))
    return {task.name: f"{boards(task.board) + 1}-{task.name}" for task in tasks}


def compute_positions(layout: Layout, rack: RackTiming) -> dict[str, tuple[float, float]]:
    """Return a dictionary from task to its position in the graph.

    Each rank of the hierarchy is one row, or several rows if it has many boards. Planners are to
    the right of their boards, and boards outside the hierarchy are in a column on the left.
    """
    placed: dict[str, tuple[int, int]] = {}
    next_row = 0
    for boards in rack.ranks:
        step = 1 + any(rack.boards[board].has_planner for board in boards)
        for index, board in enumerate(boards):
            placed[board] = index % MAX_ROW_BOARDS * step, next_row + index // MAX_ROW_BOARDS
        next_row += -(-len(boards) // MAX_ROW_BOARDS)
    others = [t.board for t in layout.tasks if t.role == "executor" and t.board not in placed]
    placed |= {board: (-1, row) for row, board in enumerate(others)}
    return {
        task.name: (
            (placed[task.board][0] + (task.role == "planner")) * COLUMN,
            placed[task.board][1] * ROW,
        )
        for task in layout.tasks
    }
