"""Takes snapshots of a running rack: one row for each task, holds, and the progress of its task."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from rack.backplane.bounded_toml import load_toml
from rack.backplane.checked import to_enum
from rack.backplane.fault_table import FaultTable, Stage
from rack.backplane.layout import TaskSpec
from rack.backplane.lines import UtilityLines
from rack.backplane.message import AnyMessage, format_state, get_reason
from rack.backplane.segment import Segment
from rack.backplane.standby import ReplicatedTask, list_standbys
from rack.backplane.trace import open_trace_ring
from rack.backplane.words import Block, Demand, Run, Scheduler, System, TaskState
from rack.boards.exchange import EXCHANGE_PORT, PortAge, list_port_ages
from rack.boards.timing.trace_times import compute_execution_ns, compute_lateness_ns
from rack.tools.monitor.holds import Hold, find_holds
from rack.tools.monitor.host_side import (
    EntryRow,
    HostRow,
    count_restarts,
    list_entry_rows,
    list_host_rows,
)
from rack.tools.monitor.interrupts import InboxFill, list_inbox_fills
from rack.tools.monitor.network import (
    ExportRow,
    ImportRow,
    PeerRow,
    list_exports,
    list_imports,
    list_peers,
)
from rack.tools.monitor.newest_messages import NewestMessages
from rack.tools.monitor.queues import QueueFill, list_queue_fills

LOST = "lost"
"""State of a task that died or does not respond, until its new process has rejoined."""
DEAD = "dead"
"""State of a run whose launcher has ended. `rack clean` removes it."""
HELD_WARNING = "HELD: 'rack step {}' continues it"
"""Warning about a rack in lockstep that is held between two ticks."""
TASK_STATUS = "task_status"
"""Message type of the level that reports the progress of the whole task."""


@dataclass(frozen=True)
class TaskRow:
    """Current state of one task.

    Attributes:
        priority: SCHED_FIFO priority obtained. 0 for ordinary scheduling.
        scheduler: Its scheduler, as in a config.
        exec_ms: Longest execution time of the cycles that `RackMonitor` covers. None without a
            cycle.
        lateness_ms: Longest lateness of these cycles.
        row: State-table row that was executed.
        mode: "operator" while a command of an operator is in force, otherwise "automatic". Empty
            for tasks that take no commands.
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
    scheduler: str


@dataclass(frozen=True)
class TaskProgress:
    """Progress of the task: elemental moves and actions, completed and in total."""

    moves_done: int
    moves: int
    actions_done: int
    actions: int
    state: str
    reason: str


@dataclass(frozen=True)
class Snapshot:
    """State of a rack at one moment.

    Attributes:
        time_s: Simulated time.
        lines: Asserted utility lines, and warnings.
        demand: Safety demand on the arm, normally "none".
        faults: Active faults.
        holds: Levels and boards that cannot proceed, and a braked arm.
        hosts: Boards of the host side.
        entries: Traffic to and from the host boards.
        queues: All queues, including empty ones.
        inboxes: Inboxes of the boards that messages interrupt.
        exchanges: For each board with an exchange, a dictionary from port to the age of the
            message in use.
        peers: Other racks on the network.
        imports: Messages from other racks.
        exports: Messages to other racks.
        standbys: Tasks with standbys: which copy is active, since when and why.
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
    standbys: tuple[ReplicatedTask, ...] = ()


class RackMonitor:
    """Takes snapshots of one rack.

    Args:
        segment: The rack.
        keeps_longest: True to report the longest times since the first snapshot, or since
            `forget_times`. By default each snapshot covers the cycles since the previous one.

    Attributes:
        cycles: Trace records of each task since the previous snapshot.
    """

    def __init__(self, segment: Segment, keeps_longest: bool = False) -> None:
        self._segment = segment
        self._newest = NewestMessages(segment)
        self._lines = UtilityLines(segment)
        self._faults = FaultTable(segment)
        self._joints = tuple(load_toml(segment.config).get("robot", {}).get("joints", ()))
        self._traces = {
            task.name: open_trace_ring(segment, task.name) for task in segment.layout.tasks
        }
        self.cycles: dict[str, np.ndarray] = {}
        self._keeps_longest = keeps_longest
        self._longest_ns: dict[str, np.ndarray] = {}

    def take_snapshot(self) -> Snapshot:
        """Take a snapshot."""
        segment = self._segment
        words = segment.words
        layout = segment.layout
        run = DEAD
        if segment.launcher_is_alive:
            run = to_enum(Run, words[System.STATE]).name.lower()
        tick = words[System.TICK]
        return Snapshot(
            rack=layout.rack,
            run=run,
            tick=tick,
            time_s=tick * layout.clock_ns * 1e-9,
            clock_skipped=words[System.CLOCK_SKIPPED],
            lines=tuple(self._list_warnings()),
            demand=to_enum(Demand, words[System.DEMAND]).name.lower(),
            faults=tuple(self._list_active_faults()),
            tasks=tuple(
                self._describe_task(task)
                for task in sorted(layout.tasks, key=lambda t: (t.slot, t.role))
            ),
            progress=self._find_progress(),
            holds=find_holds(self._newest),
            hosts=tuple(list_host_rows(segment)),
            entries=tuple(list_entry_rows(self._newest)),
            queues=tuple(list_queue_fills(self._newest)),
            inboxes=tuple(list_inbox_fills(segment)),
            peers=tuple(list_peers(self._newest)),
            imports=tuple(list_imports(self._newest)),
            exports=tuple(list_exports(self._newest)),
            standbys=list_standbys(segment),
            exchanges={
                board: list_port_ages(message)
                for board, message in self._list_messages(EXCHANGE_PORT)
            },
        )

    def _list_active_faults(self) -> Iterator[str]:
        """Yield a description of each active fault."""
        for fault in self._faults.list_entries((Stage.ACTIVE,)):
            # Import late: most racks have no faults, and the import takes a while.
            from rack.boards.faults.describe import describe_fault
            from rack.boards.faults.kind import UNKNOWN, find_kind

            if find_kind(fault) is UNKNOWN:
                from rack.boards.config.published import PublishedRack

                # This call also registers the kinds that the levels of the rack add.
                PublishedRack.read_from_segment(self._segment)
            yield describe_fault(fault, self._segment.layout, self._joints)

    def _list_warnings(self) -> Iterator[str]:
        """Yield the names of asserted utility lines, and warnings about the rack."""
        lines = self._lines
        yield from (f"SYSFAIL slot {slot}" for slot in lines.sysfail)
        single = {
            "ACFAIL": lines.acfail,
            "SYSRESET": lines.sysreset,
            "EMERGENCY STOP": lines.emergency_stop,
        }
        yield from (name for name, asserted in single.items() if asserted)
        words = self._segment.words
        tasks = [task.name for task in self._segment.layout.tasks if task.priority]
        blocks = zip(tasks, map(self._segment.get_block, tasks), strict=True)
        refused = [name for name, block in blocks if block[Block.PID] and not block[Block.PRIORITY]]
        if refused and words[System.STATE] != Run.STARTING and not words[System.LOCKSTEP]:
            yield f"NO REAL-TIME PRIORITY: {', '.join(refused)}"
        if words[System.HELD]:
            yield HELD_WARNING.format(self._segment.rack)
        if count := words[System.SNAPSHOTS]:
            yield f"{count} SNAPSHOTS, {words[System.SNAPSHOT_BYTES] / 1e6:.0f} MB"

    def _describe_task(self, task: TaskSpec) -> TaskRow:
        """Return the current state of a task."""
        block = self._segment.get_block(task.name)
        exec_ms, lateness_ms = self._longest_times_ms(task.name)
        state = to_enum(TaskState, block[Block.STATE]).name.lower()
        reason = row = mode = ""
        if block[Block.LOST]:
            state = LOST
        elif (status := self._newest.read_message(f"{task.name}.status")) is not None:
            # A user's level may report no known state. Show the state of its process instead.
            state = format_state(getattr(status, "state", None), state)
            reason = get_reason(status)
            row = format_table_row(status)
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
            skipped=self._segment.count_cycles(task, self._segment.tick - 1).skipped,
            restarts=count_restarts(self._segment, task.name),
            exec_ms=exec_ms,
            lateness_ms=lateness_ms,
            reason=reason,
            row=row,
            mode=mode,
            scheduler=to_enum(Scheduler, block[Block.SCHEDULER] or 1).word,
        )

    def forget_times(self) -> None:
        """Reset the longest times of all tasks."""
        self._longest_ns.clear()

    def _longest_times_ms(self, task: str) -> list[float | None]:
        """Return the longest execution time and lateness of a task in ms.

        Without a new cycle the previous times are returned, or None before the first cycle.
        """
        self.cycles[task] = cycles = self._traces[task].read_new_rows().rows
        longest = self._longest_ns.get(task)
        if len(cycles):
            newest = np.array(
                [compute_execution_ns(cycles).max(), compute_lateness_ns(cycles).max()]
            )
            if longest is not None and self._keeps_longest:
                newest = np.maximum(longest, newest)
            longest = self._longest_ns[task] = newest
        return [None, None] if longest is None else (longest * 1e-6).tolist()

    def _list_messages(self, message: str) -> Iterator[tuple[str, AnyMessage]]:
        """Yield the writer and the newest message of every mailbox of a message type."""
        return self._newest.list_messages(lambda box: box.message == message)

    def _find_progress(self) -> TaskProgress | None:
        """Return the progress of the task. None if no level reports it."""
        for _, status in self._list_messages(TASK_STATUS):
            state = format_state(status.state)
            return TaskProgress(
                status.moves_done, status.moves, status.action, status.actions, state, status.reason
            )
        return None


def format_table_row(status: AnyMessage) -> str:
    """Format the state-table row that a level executed in its newest cycle.

    Empty for a level without a state table.
    """
    if not {"row", "fired", "in_state", "table"} <= {*(status.record.dtype.names or ())}:
        return ""
    row_text = f"row {status.row} '{status.fired}'" if status.row else "no row"
    return f"{row_text}, now in '{status.in_state}', table {status.table}"
