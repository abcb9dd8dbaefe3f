"""Shows the levels: lanes for states and moves, log lines for errors, and a graph."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from enum import IntEnum
from functools import partial
from typing import Any

import numpy as np
import rerun as rr

from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.message import State, decode_text
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.trace_times import find_missed_cycles
from rack.levels.messages import Verb
from rack.levels.systems.hand.messages import GraspKind
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


def build_value_lane(
    stream: Stream, lane: tuple[str, str], fields: str | list[str], name: Callable[[Any], str]
) -> ViewPart:
    """Return the view part that shows a value in a level's messages as a lane.

    Args:
        stream: Stream to write to.
        lane: Name of the board, and name of the lane.
        fields: Field with the value. For several fields, the value is a tuple.
        name: Function that returns the text for a value.
    """
    changed_rows = build_change_finder()

    def write(block: RowBlock) -> None:
        """Write the text for the value at every row in which the value changes."""
        values = block.messages[fields]
        rows = changed_rows(values)
        if len(rows):
            names = [name(value) for value in values[rows].tolist()]
            write_spans(stream, (LEVELS, *lane), block.build_time_columns(rows), names)

    return write


def format_serial(serial: int) -> str:
    """Format the number of a command or motion request. Returns "" for 0, which means none."""
    return str(serial) if serial else ""


def format_step(step: tuple[int, int]) -> str:
    """Format a step of a grasp, given as number of earlier steps and kind of step."""
    return f"{step[0] + 1} {format_enum(GraspKind, step[1])}"


def format_move(move: tuple[int, int]) -> str:
    """Format a move, given as serial and verb. Returns "" for serial 0, which means no move."""
    return format_enum(Verb, move[1]) if move[0] else ""


def format_enum(kind: type[IntEnum], number: int) -> str:
    """Return the name of an enum member with this number, in lower case and with spaces."""
    return kind(number).name.lower().replace("_", " ")


def build_state_lane(stream: Stream, mailbox: MailboxSpec) -> Iterator[ViewPart]:
    """Yield the view parts that show a level's states as a lane and its errors as log lines."""
    board, _, port = mailbox.name.partition(".")
    # An adapter also writes the statuses of other racks' levels, one port for each.
    lane = board, "state" if port == "status" else port
    style_lane(stream, (LEVELS, *lane), STATES)
    yield build_value_lane(stream, lane, "state", partial(format_enum, State))
    changed_rows = build_change_finder()

    def write_errors(block: RowBlock) -> None:
        """Write a log line for each new error in a block of messages."""
        messages = block.messages
        for row in changed_rows(messages["error"]):
            if error := messages["error"][row]:
                reason = decode_text(messages["reason"][row])
                text = f"{board}: {reason or f'error {error}'}"
                stream.log_line(block.find_moment(row), "levels", text, "ERROR")

    yield write_errors


def build_fired_lane(stream: Stream, mailbox: MailboxSpec) -> ViewPart:
    """Return the view part that writes the fired row of a state table to a lane and the log."""
    board = mailbox.name.partition(".")[0]
    changed_rows = build_change_finder()

    def write(block: RowBlock) -> None:
        """Write the fired row to the lane and to the log whenever it changes."""
        changed = changed_rows(block.messages[FIRED])
        names = []
        for row_index in changed:
            table, row, fired, state = block.messages[FIRED][row_index]
            names.append(f"{row} {decode_text(fired)}")
            now = f"now in '{decode_text(state)}', table {decode_text(table)}"
            text = f"row {row} '{decode_text(fired)}', {now}"
            stream.log_line(
                block.find_moment(row_index), "rows", f"{board}: {text}", "INFO" if row else "ERROR"
            )
        if names:
            write_spans(stream, (LEVELS, board, "row"), block.build_time_columns(changed), names)

    return write


class Hierarchy:
    """Writes the tasks as nodes of a graph, coloured by state.

    Higher levels are drawn above lower levels, and boards outside the hierarchy to their left.
    Edges lead from each level to the levels below it, and from each planner to its board. Changes
    of state are collected until `write_changes` writes them.
    """

    def __init__(self, stream: Stream, layout: Layout, rack: RackTiming) -> None:
        self._stream = stream
        self._tasks = [task.name for task in layout.tasks]
        self._states = dict.fromkeys(self._tasks, "idle")  # the newest states
        self._shown = dict(self._states)  # the states that the graph shows
        self._positions = compute_positions(layout, rack)
        self._changes: list[tuple[Moment, str, str]] = []
        downward = [(board.name, below) for board in rack.boards.values() for below in board.below]
        plans = [(task.name, task.board) for task in layout.tasks if task.role == "planner"]
        stream.log_static((HIERARCHY,), rr.GraphEdges(downward + plans, graph_type="directed"))
        self._write_graph(stream.times.estimate_moment(0))

    def write(self, task: str, block: RowBlock) -> None:
        """Collect the changes of a task's state from a block of its trace records."""
        names = _name_states(block.rows)
        before = np.concatenate(([self._states[task]], names[:-1]))
        for row in np.flatnonzero(names != before):
            self._add_change(block.find_moment(row), task, str(names[row]))

    def mark_lost(self, when: Moment, board: str) -> None:
        """Set the state of a board that died or stopped responding to "lost"."""
        if board in self._states:
            self._add_change(when, board, "lost")

    def mark_recovered(self, when: Moment, board: str) -> None:
        """Set the state of a restarted board to "idle", until its next cycles show its state."""
        if self._states.get(board) == "lost":
            self._add_change(when, board, "idle")

    def _add_change(self, when: Moment, task: str, state: str) -> None:
        """Add a change of state that `write_changes` will write."""
        self._changes.append((when, task, state))
        self._states[task] = state

    def write_changes(self) -> None:
        """Write the collected changes of state, earliest first."""
        for when, task, state in sorted(self._changes):
            self._shown[task] = state
            self._write_graph(when)
        self._changes.clear()

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


def _name_states(rows: np.ndarray) -> np.ndarray:
    """Return the state of the level in each trace record, or "missed" for a missed cycle."""
    names = np.array([state.name.lower() for state in State] + ["missed"])
    indices = np.where(find_missed_cycles(rows), len(names) - 1, rows["state"])
    return np.asarray(names[indices])


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
