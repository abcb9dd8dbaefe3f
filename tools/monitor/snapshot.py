"""A snapshot of a running rack, from the host side: one row a task, what holds the rack, the
progress of its task.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from rack.backplane.bounded_toml import load_toml
from rack.backplane.checked import as_named
from rack.backplane.fault_table import FaultTable, Stage
from rack.backplane.layout import TaskSpec
from rack.backplane.lines import UtilityLines
from rack.backplane.message import AnyMessage, reason_of, state_name
from rack.backplane.segment import Segment
from rack.backplane.trace import trace_ring
from rack.backplane.words import Block, Demand, Run, System, TaskState
from rack.boards.exchange import EXCHANGE, PortAge, ages_of
from rack.boards.timing.trace_times import execution_ns, lateness_ns
from rack.tools.monitor.holds import Hold, find_holds
from rack.tools.monitor.host_side import EntryRow, HostRow, entry_rows, host_rows, restarts
from rack.tools.monitor.interrupts import InboxFill, inbox_fills
from rack.tools.monitor.network import (
    ExportRow,
    ImportRow,
    PeerRow,
    export_rows,
    import_rows,
    peer_rows,
)
from rack.tools.monitor.newest_messages import Newest
from rack.tools.monitor.queues import QueueFill, queue_fills

LOST = "lost"
"""State of a task that died or does not respond, until its new process has rejoined."""
DEAD = "dead"
"""State of a run whose launcher is gone: 'rack clean' removes it."""
HELD = "HELD: 'rack step {}' lets it go on"
"""Line of a rack in lockstep that is single-stepped."""
TASK_STATUS = "task_status"
"""Message type of the level that reports the progress of the whole task."""


@dataclass(frozen=True)
class TaskRow:
    """One task now. Times are the longest of the newest cycles, in ms, or of all: see
    `RackMonitor`; None before the first.

    `priority` is the SCHED_FIFO priority obtained, 0 for ordinary scheduling. `mode` is "operator"
    while a command of an operator is in force, otherwise "automatic"; empty for tasks that take
    none. `row` is what fired of a state table.
    """

    task: str
    slot: int
    core: int
    priority: int
    rate_hz: float
    state: str
    tick: int
    cycles: int
    plans: int
    missed: int
    skipped: int
    restarts: int
    exec_ms: float | None
    lateness_ms: float | None
    reason: str
    row: str
    mode: str


@dataclass(frozen=True)
class TaskProgress:
    """Progress of the task: elemental moves and actions done, of how many."""

    moves_done: int
    moves: int
    actions_done: int
    actions: int
    state: str
    reason: str


@dataclass(frozen=True)
class Snapshot:
    """A rack now. `time_s` is simulated time; `lines` are the utility lines asserted, and warnings.

    `demand` is the safety demand on the arm, normally "none"; `faults` are the active ones; `holds`
    are the levels, or the arm, that are kept from their work; `hosts` the boards of the host side,
    `entries` what passes to and from them; `queues` are all of them, empty ones too; `inboxes`
    those of boards that messages interrupt; `exchanges` the messages in use of boards with an
    exchange, by port; `peers` other racks on the network, `imports` and `exports` what passes to
    and from them.
    """

    rack: str
    run: str
    tick: int
    time_s: float
    clock_skipped: int
    lines: tuple[str, ...]
    demand: str
    faults: tuple[str, ...]
    tasks: tuple[TaskRow, ...]
    progress: TaskProgress | None
    holds: tuple[Hold, ...]
    hosts: tuple[HostRow, ...]
    entries: tuple[EntryRow, ...]
    queues: tuple[QueueFill, ...]
    inboxes: tuple[InboxFill, ...]
    exchanges: Mapping[str, Mapping[str, PortAge]]
    peers: tuple[PeerRow, ...]
    imports: tuple[ImportRow, ...]
    exports: tuple[ExportRow, ...]


class RackMonitor:
    """Takes snapshots of one rack; each covers the cycles since the one before, with
    `keeps_longest` all since the first, or since `forget_times`.
    """

    def __init__(self, segment: Segment, keeps_longest: bool = False) -> None:
        self._segment = segment
        self._newest = Newest(segment)
        self._lines = UtilityLines(segment)
        self._faults = FaultTable(segment)
        robot = load_toml(segment.config).get("robot", {})
        self._joints = tuple(robot.get("joints", ()))
        self._traces = {task.name: trace_ring(segment, task.name) for task in segment.layout.tasks}
        self.cycles: dict[str, np.ndarray] = {}
        """Trace records of each task that the last look took."""
        self._keeps_longest = keeps_longest
        self._longest_ns: dict[str, np.ndarray] = {}

    def look(self) -> Snapshot:
        """Return the rack as it is now."""
        segment = self._segment
        words = segment.words
        layout = segment.layout
        run = DEAD
        if segment.launcher_is_alive:
            run = as_named(Run, words[System.STATE]).name.lower()
        tick = words[System.TICK]
        return Snapshot(
            rack=layout.rack,
            run=run,
            tick=tick,
            time_s=tick * layout.clock_ns * 1e-9,
            clock_skipped=words[System.CLOCK_SKIPPED],
            lines=tuple(self._asserted()),
            demand=as_named(Demand, words[System.DEMAND]).name.lower(),
            faults=tuple(self._active_faults()),
            tasks=tuple(
                self._row(task) for task in sorted(layout.tasks, key=lambda t: (t.slot, t.role))
            ),
            progress=self._progress(),
            holds=find_holds(self._newest),
            hosts=host_rows(segment),
            entries=entry_rows(self._newest),
            queues=queue_fills(self._newest),
            inboxes=inbox_fills(segment),
            peers=peer_rows(self._newest),
            imports=import_rows(self._newest),
            exports=export_rows(self._newest),
            exchanges={board: ages_of(message) for board, message in self._of_type(EXCHANGE)},
        )

    def _active_faults(self) -> Iterator[str]:
        for fault in self._faults.staged((Stage.ACTIVE,)):
            # The kinds of faults take a while to import; most racks have none.
            from rack.boards.faults.describe import describe
            from rack.boards.faults.kind import UNKNOWN, kind_of

            if kind_of(fault) is UNKNOWN:
                from rack.boards.config.published import PublishedRack

                # A kind that the rack's levels add is known once this is read.
                PublishedRack.of_rack(self._segment)
            yield describe(fault, self._segment.layout, self._joints)

    def _asserted(self) -> list[str]:
        """Return the utility lines asserted, and warnings."""
        lines = self._lines
        shown = [f"SYSFAIL slot {slot}" for slot in lines.sysfail]
        single = {
            "ACFAIL": lines.acfail,
            "SYSRESET": lines.sysreset,
            "EMERGENCY STOP": lines.emergency_stop,
        }
        shown += [name for name, asserted in single.items() if asserted]
        words = self._segment.words
        tasks = [task.name for task in self._segment.layout.tasks if task.priority]
        blocks = [(name, self._segment.block(name)) for name in tasks]
        refused = [name for name, block in blocks if block[Block.PID] and not block[Block.PRIORITY]]
        if refused and words[System.STATE] != Run.STARTING and not words[System.LOCKSTEP]:
            shown.append(f"NO REAL-TIME PRIORITY: {', '.join(refused)}")
        if words[System.HELD]:
            shown.append(HELD.format(self._segment.rack))
        if count := words[System.SNAPSHOTS]:
            shown.append(f"{count} SNAPSHOTS, {words[System.SNAPSHOT_BYTES] / 1e6:.0f} MB")
        return shown

    def _row(self, task: TaskSpec) -> TaskRow:
        block = self._segment.block(task.name)
        exec_ms, lateness_ms = self._times_ms(task.name)
        state = as_named(TaskState, block[Block.STATE]).name.lower()
        reason = row = mode = ""
        if block[Block.LOST]:
            state = LOST
        elif (status := self._newest.message(f"{task.name}.status")) is not None:
            # Of a user's level without a state, or with others, it is that of its process.
            state = state_name(getattr(status, "state", None), state)
            reason = reason_of(status)
            row = fired(status)
            standing = getattr(status, "standing", None)
            mode = "" if standing is None else "operator" if standing else "automatic"
        return TaskRow(
            task=task.name,
            slot=task.slot,
            core=block[Block.CORE],
            priority=block[Block.PRIORITY],
            rate_hz=1e9 / (task.every * self._segment.layout.clock_ns),
            state=state,
            tick=block[Block.DONE],
            cycles=block[Block.CYCLES],
            plans=block[Block.PLANS],
            missed=block[Block.MISSED],
            skipped=self._segment.count_cycles(task, self._segment.words[System.TICK] - 1).skipped,
            restarts=restarts(self._segment, task.name),
            exec_ms=exec_ms,
            lateness_ms=lateness_ms,
            reason=reason,
            row=row,
            mode=mode,
        )

    def forget_times(self) -> None:
        """Begin again with the longest times."""
        self._longest_ns.clear()

    def _times_ms(self, task: str) -> list[float | None]:
        """Return the longest execution and lateness of a task; where a look sees no cycle, as
        before.
        """
        self.cycles[task] = cycles = self._traces[task].drain().rows
        longest = self._longest_ns.get(task)
        if len(cycles):
            newest = np.array([execution_ns(cycles).max(), lateness_ns(cycles).max()])
            if longest is not None and self._keeps_longest:
                newest = np.maximum(longest, newest)
            longest = self._longest_ns[task] = newest
        return [None, None] if longest is None else (longest * 1e-6).tolist()

    def _of_type(self, message: str) -> Iterator[tuple[str, AnyMessage]]:
        """Yield the newest message in every mailbox of a message type, with its writer."""
        return self._newest.messages(lambda box: box.message == message)

    def _progress(self) -> TaskProgress | None:
        for _, at in self._of_type(TASK_STATUS):
            state = state_name(at.state)
            return TaskProgress(at.moves_done, at.moves, at.action, at.actions, state, at.reason)
        return None


def fired(status: AnyMessage) -> str:
    """Return what fired of a state table in a level's newest cycle, as text; empty for a level
    without one.
    """
    if not {"row", "fired", "in_state", "table"} <= {*(status.record.dtype.names or ())}:
        return ""
    what = f"row {status.row} '{status.fired}'" if status.row else "no row"
    return f"{what}, now in '{status.in_state}', table {status.table}"
