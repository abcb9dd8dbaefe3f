"""The timing of a rack in the view: lanes and curves of every task, from its trace, and the ages of
messages."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rack.backplane.layout import Layout, MailboxSpec, TaskSpec, TickGrid
from rack.levels.timing.trace_times import (
    execution_ns,
    is_missed,
    lateness_ns,
    newest_visible,
    response_ns,
)
from rack.tools.viewer.levels import LEVELS
from rack.tools.viewer.stream import Ints, RowBlock, Stream, ViewPart
from rack.tools.viewer.style import (
    COMMANDED,
    LETTERS,
    LIMIT,
    PHASES,
    Colour,
    curves,
    dimmed,
    of_joint,
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
SPAN_S = 0.25
"""Time marked around a missed cycle: the cycle itself would be too narrow to be visible."""


class CycleLanes:
    """Writes trace records as spans: read, process or plan, write, wait. Missed cycles are red.

    In real time a span is where it was on the wall clock, scaled to simulated time. In lockstep,
    where simulated time stands still meanwhile, it begins at its tick and is cut at the end of its
    time slice.
    """

    def __init__(self, stream: Stream, task: TaskSpec, speed: float, lockstep: bool) -> None:
        self._stream = stream
        self._speed = speed
        self._lane = (BOARDS, f"{task.slot}-{task.board}", task.role)  # in the order of slots
        self._last_ns = task.slice * stream.times.clock_ns - len(MOMENTS) if lockstep else None
        self._work = "process" if task.role == "executor" else "plan"
        style_lane(stream, self._lane, PHASES, LETTERS)

    def write(self, block: RowBlock) -> None:
        """Write four spans a cycle."""
        rows = block.rows
        moments = np.stack([rows[name] for name in MOMENTS], axis=1)
        within = ((moments - rows["release_ns"][:, None]) * self._speed).astype(np.int64)
        if self._last_ns is not None:
            # Cut spans keep their order: no two of a lane begin at the same time.
            within = np.minimum(within, self._last_ns + np.arange(len(MOMENTS)))
        ticks = np.repeat(block.ticks, len(MOMENTS))
        states = np.array([["read", self._work, "write", "wait"]] * len(rows))
        states[is_missed(rows), :3] = MISSED
        times = self._stream.times.columns(ticks, moments.ravel(), within.ravel())
        write_spans(self._stream, self._lane, times, states.ravel().tolist())


def boards_of(layout: Layout) -> list[str]:
    """Return the first names of tasks: planners have those of their boards."""
    return list(dict.fromkeys(task.name.partition(".")[0] for task in layout.tasks))


def colours_of(layout: Layout) -> dict[str, Colour]:
    """Return a colour for each task, by name; a planner has its board's, dimmed."""
    boards = boards_of(layout)
    own = {task.name: of_joint(boards.index(task.name.partition(".")[0])) for task in layout.tasks}
    return {name: dimmed(colour) if "." in name else colour for name, colour in own.items()}


def load_curves(
    stream: Stream, task: TaskSpec, colour: Colour, period_ns: int, is_lockstep: bool
) -> Iterator[ViewPart]:
    """Yield the parts that write trace records as curves: lateness, execution and deadline in ms,
    and the used part of the time slice, whose 100 % are the deadline.

    In lockstep a tick lasts as long as its tasks take: there is only execution, without anything to
    compare it with.
    """
    slice_ns = task.slice * period_ns

    def times_ms(block: RowBlock) -> np.ndarray:
        rows = block.rows
        found = np.full((len(rows), 3), np.nan)
        found[:, 1] = execution_ns(rows) * 1e-6
        if not is_lockstep:
            found[:, 0] = lateness_ns(rows) * 1e-6
            found[:, 2] = slice_ns * 1e-6
        return found

    names = [f"{task.name} {name}" for name in ("lateness, ms", "execution, ms", "deadline, ms")]
    yield curves(stream, (TIMES, task.name), times_ms, names, [COMMANDED, colour, LIMIT])
    if not is_lockstep:
        yield curves(
            stream,
            (LOAD, task.name),
            lambda block: response_ns(block.rows) * (100.0 / slice_ns),
            [f"{task.name}, %"],
            [colour],
        )


class Misses:
    """Writes missed cycles: as a lane that shows them at any zoom, and as one log line a block.

    A task that never misses has no lane.
    """

    def __init__(self, stream: Stream, task: TaskSpec) -> None:
        self._stream = stream
        self._task = task.name
        self._lane = (LEVELS, task.board, f"{task.role}_{MISSED}")
        self._span = max(1, round(SPAN_S * 1e9 / stream.times.clock_ns))
        self._is_styled = False

    def write(self, block: RowBlock) -> None:
        """Write the cycles that were missed."""
        missed = np.flatnonzero(is_missed(block.rows))
        if not len(missed):
            return
        if not self._is_styled:
            style_lane(self._stream, self._lane, {MISSED: PHASES[MISSED]})
            self._is_styled = True
        ticks = block.ticks[missed]
        self._mark(np.unique(ticks // self._span))
        which = f"tick {ticks[0]}"
        if len(ticks) > 1:
            which = f"{len(ticks)} cycles, ticks {ticks[0]} to {ticks[-1]}"
        self._stream.say(block.when(missed[0]), "misses", f"missed: {self._task}: {which}", "WARN")

    def _mark(self, spans: np.ndarray) -> None:
        ends = np.setdiff1d(spans + 1, spans)
        moments = np.concatenate((spans, ends))
        order = np.argsort(moments)
        ticks = moments[order] * self._span
        states = np.array([MISSED] * len(spans) + [""] * len(ends))[order]
        times = self._stream.times
        columns = times.columns(ticks, times.stamps_of(ticks))
        write_spans(self._stream, self._lane, columns, states.tolist())


class Age:
    """Writes, at every release of a mailbox's fastest reader, the age in ms of the message that is
    visible then."""

    def __init__(
        self, stream: Stream, mailbox: MailboxSpec, layout: Layout, colour: Colour
    ) -> None:
        self._stream = stream
        self._lane = (AGES, mailbox.name)
        own = TickGrid(mailbox.every, mailbox.phase)
        self._releases = min(
            [layout.read_grid(mailbox, reader) for reader in mailbox.readers], default=own
        )
        self._visible_at: Ints = np.empty(0, dtype=np.int64)
        self._made: Ints = np.empty(0, dtype=np.int64)
        self._upto = -1
        style_curves(stream, self._lane, [f"{mailbox.name}, ms"], [colour])

    def write(self, block: RowBlock) -> None:
        """Take messages; they count from the tick at which they become visible."""
        self._visible_at = np.concatenate((self._visible_at, block.rows["visible_at"]))
        self._made = np.concatenate((self._made, block.ticks))

    def skip(self, tick: int) -> None:
        """Go on at a tick, with no message from before."""
        self._upto = tick - 1
        self._visible_at = self._visible_at[:0]
        self._made = self._made[:0]

    def advance(self, tick: int) -> None:
        """Write the ages at all releases before `tick`; every message visible before it has been
        taken."""
        releases = np.arange(self._releases.since(self._upto + 1), tick, self._releases.every)
        self._upto = max(self._upto, tick - 1)
        newest = newest_visible(releases, self._visible_at)
        releases = releases[newest >= 0]
        newest = newest[newest >= 0]
        if not len(releases):
            return
        times = self._stream.times
        ages = (releases - self._made[newest]) * times.clock_ns * 1e-6
        self._stream.scalars(self._lane, times.columns(releases, times.stamps_of(releases)), ages)
        self._visible_at = self._visible_at[newest[-1] :]
        self._made = self._made[newest[-1] :]
