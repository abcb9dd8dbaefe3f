"""Shows the timing of a rack: lanes and curves of tasks, and ages of messages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rack.backplane.layout import Layout, MailboxSpec, TaskSpec, TickGrid
from rack.boards.timing.trace_times import (
    compute_execution_ns,
    compute_lateness_ns,
    compute_response_ns,
    find_missed_cycles,
    find_newest_visible,
)
from rack.tools.viewer.stream import Ints, Moment, RowBlock, Stream, ViewPart
from rack.tools.viewer.style import (
    COMMANDED,
    LETTERS,
    LIMIT,
    PHASES,
    Colour,
    build_curves,
    choose_joint_colours,
    dim_colour,
    style_curves,
    style_lane,
    write_spans,
)

BOARDS = "boards"
LOAD = "load"
TIMES = "times"
AGES = "ages"
MOMENTS = ("start_ns", "read_ns", "process_ns", "end_ns")
MISSED = "missed"


class CycleLane:
    """Writes each cycle of a task as four spans: read, process or plan, write, wait.

    Missed cycles are red, and so is the time for which the task is lost. In real time, the spans
    are shown at their wall-clock times, scaled to simulated time. In lockstep, simulated time does
    not pass during a cycle. The spans then begin at the tick, and are cut off at the end of the
    time slice.

    Args:
        stream: Stream to write to.
        task: The task.
        board: Name of its board in lanes.
        speed: Ratio of simulated time to wall-clock time.
        lockstep: Whether the run is in lockstep.
    """

    def __init__(
        self, stream: Stream, task: TaskSpec, board: str, speed: float, lockstep: bool
    ) -> None:
        self._stream = stream
        is_standby = task.role == "standby"
        lane = task.name.removeprefix(f"{task.board}.") if is_standby else task.role
        self._lane = (BOARDS, board, lane)
        self._every = task.every
        self._last_ns = task.slice * stream.times.clock_ns - len(MOMENTS)
        self._work = "plan" if task.role == "planner" else "process"
        self._speed = speed
        self._lockstep = lockstep
        # Ticks of the cycles in the newest block, and the last one before it; and their ends in ns.
        self._ticks: Ints = np.empty(0, dtype=np.int64)
        self._ends: Ints = np.empty(0, dtype=np.int64)
        style_lane(stream, self._lane, PHASES, LETTERS)

    def write(self, block: RowBlock) -> None:
        """Write the four spans of each cycle in a block."""
        rows = block.rows
        moments = np.stack([rows[name] for name in MOMENTS], axis=1)
        within = ((moments - rows["release_ns"][:, None]) * self._speed).astype(np.int64)
        if self._lockstep:
            # Let cut-off spans begin at different times, in the right order.
            within = np.minimum(within, self._last_ns + np.arange(len(MOMENTS)))
        ticks = np.repeat(block.ticks, len(MOMENTS))
        states = np.array([["read", self._work, "write", "wait"]] * len(rows))
        states[find_missed_cycles(rows), :3] = MISSED
        times = self._stream.times.build_columns(ticks, moments.ravel(), within.ravel())
        write_spans(self._stream, self._lane, times, states.ravel().tolist())
        ends = block.ticks * self._stream.times.clock_ns + within[:, -1]
        self._ticks = np.concatenate((self._ticks[-1:], block.ticks))
        self._ends = np.concatenate((self._ends[-1:], ends))

    def mark_lost(self, when: Moment) -> Moment:
        """Write the state "lost", which the next cycle ends, but only after the previous cycle.

        Args:
            when: Time at which the loss was noticed.

        Returns:
            Time of the loss. If it was noticed late, the task was already lost at the release after
            its last cycle.
        """
        times = self._stream.times
        within = 0
        if count := int(np.searchsorted(self._ticks, when.tick, "right")):
            if (missed := int(self._ticks[count - 1]) + self._every) < when.tick:
                when = times.estimate_moment(missed)
            within = max(0, int(self._ends[count - 1]) + 1 - when.tick * times.clock_ns)
        columns = times.build_columns(np.array([when.tick]), np.array([when.stamp_ns]), within)
        write_spans(self._stream, self._lane, columns, ["lost"])
        return when


def choose_task_colours(layout: Layout, boards: Sequence[str]) -> dict[str, Colour]:
    """Return a dictionary from task to colour. A planner has the dimmed colour of its board."""
    by_board = dict(zip(boards, choose_joint_colours(len(boards)), strict=True))
    by_task = {task.name: by_board[task.board] for task in layout.tasks}
    return {name: dim_colour(colour) if "." in name else colour for name, colour in by_task.items()}


def build_load_curves(
    stream: Stream, task: TaskSpec, colour: Colour, due_ns: int, is_lockstep: bool
) -> Iterator[ViewPart]:
    """Yield the view parts that show the times of a task as curves.

    These are lateness, execution time and deadline in ms, and the used part of the time until the
    deadline in percent. In lockstep a tick lasts as long as its tasks take, so
    only the execution time is shown, in ms and in percent.

    Args:
        stream: Stream to write to.
        task: The task.
        colour: Colour of the task.
        due_ns: Time from a release to the deadline on the wall clock.
        is_lockstep: Whether the run is in lockstep.
    """

    def times_ms(block: RowBlock) -> np.ndarray:
        """Return lateness, execution time and deadline of each cycle in ms, shape (rows, 3)."""
        rows = block.rows
        columns = np.full((len(rows), 3), np.nan)
        columns[:, 1] = compute_execution_ns(rows) * 1e-6
        if not is_lockstep:
            columns[:, 0] = compute_lateness_ns(rows) * 1e-6
            columns[:, 2] = due_ns * 1e-6
        return columns

    names = [f"{task.name} {name}" for name in ("lateness, ms", "execution, ms", "deadline, ms")]
    yield build_curves(stream, (TIMES, task.name), times_ms, names, [COMMANDED, colour, LIMIT])
    compute_used_ns = compute_execution_ns if is_lockstep else compute_response_ns
    yield build_curves(
        stream,
        (LOAD, task.name),
        lambda block: compute_used_ns(block.rows) * (100.0 / due_ns),
        [f"{task.name}, %"],
        [colour],
    )


def build_miss_lines(stream: Stream, task: TaskSpec) -> ViewPart:
    """Return the view part that shows the missed cycles of each block as a log line."""

    def write(block: RowBlock) -> None:
        """Write a log line, unless no cycle was missed."""
        missed = np.flatnonzero(find_missed_cycles(block.rows))
        if len(missed):
            ticks = block.ticks[missed]
            which = f"tick {ticks[0]}"
            if len(ticks) > 1:
                which = f"{len(ticks)} cycles, ticks {ticks[0]} to {ticks[-1]}"
            text = f"missed: {task.name}: {which}"
            stream.log_line(block.find_moment(missed[0]), "misses", text, "WARN")

    return write


class AgeWriter:
    """Writes the age in ms of the newest visible message at every release of its fastest reader."""

    def __init__(
        self, stream: Stream, mailbox: MailboxSpec, layout: Layout, colour: Colour
    ) -> None:
        self._stream = stream
        self._lane = (AGES, mailbox.name)
        own_grid = TickGrid(mailbox.every, mailbox.phase)
        self._releases = min(
            [layout.find_read_grid(mailbox, reader) for reader in mailbox.readers], default=own_grid
        )
        self._visible_at: Ints = np.empty(0, dtype=np.int64)
        self._made: Ints = np.empty(0, dtype=np.int64)
        self._upto = -1
        style_curves(stream, self._lane, [f"{mailbox.name}, ms"], [colour])

    def add_messages(self, block: RowBlock) -> None:
        """Add messages. The age of each is written from the tick at which it becomes visible."""
        self._visible_at = np.concatenate((self._visible_at, block.rows["visible_at"]))
        self._made = np.concatenate((self._made, block.ticks))

    def skip_to(self, tick: int) -> None:
        """Drop all messages, and continue at `tick` after a range that was not recorded."""
        self._upto = tick - 1
        self._visible_at = self._visible_at[:0]
        self._made = self._made[:0]

    def write_ages(self, tick: int) -> None:
        """Write the ages at all releases before `tick` that have not been written yet.

        Call this only when all messages that became visible before that tick have been added.
        """
        releases = np.arange(self._releases.find_tick(self._upto + 1), tick, self._releases.every)
        self._upto = max(self._upto, tick - 1)
        newest = find_newest_visible(releases, self._visible_at)
        releases = releases[newest >= 0]
        newest = newest[newest >= 0]
        if not len(releases):
            return
        times = self._stream.times
        ages = (releases - self._made[newest]) * times.clock_ns * 1e-6
        self._stream.send_curves(
            self._lane, times.build_columns(releases, times.estimate_stamps(releases)), ages
        )
        self._visible_at = self._visible_at[newest[-1] :]
        self._made = self._made[newest[-1] :]
