"""Plain data that the Rack sends to the crate, with everything that each process needs to run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rack.backplane.layout import ExchangeSpec
from rack.backplane.process import Reservation
from rack.backplane.words import Demand, Scheduler
from rack.levels.level import LevelContext

Source = str | Mapping[str, str]
"""Source of an input port: the name of a mailbox, or a dictionary from board to name."""


MessageRows = Sequence[tuple[int, int, bytes]]
"""Messages of a mailbox in a recorded run, oldest first.

Each row has the tick at which a message was written, the tick of the oldest information on which it
depends, and its bytes. For a mailbox that is written in every cycle, only changes have rows.
"""
RecordedEntries = Mapping[str, MessageRows]
"""Messages that an adapter wrote in a recorded run, keyed by port."""


def list_mailboxes(source: Source) -> tuple[str, ...]:
    """Return the names of the mailboxes of an input port."""
    return (source,) if isinstance(source, str) else tuple(source.values())


@dataclass(frozen=True)
class BusTimes:
    """Minimum processor time in ns of each kind of bus access, to emulate a slower bus.

    See `[board.<name>.transfer]` in a config.

    Attributes:
        read_ns: Reading commands and statuses.
        write_ns: Writing commands and statuses.
        exchange_ns: Transferring the plan from the planner's processor.
        update_ns: Writing the plan.
    """

    read_ns: int = 0
    write_ns: int = 0
    exchange_ns: int = 0
    update_ns: int = 0


@dataclass(frozen=True)
class SnapshotPolicy:
    """Policy for the snapshots of a rack in lockstep.

    Attributes:
        part: Snapshots are taken as often as possible, but stop the rack for at most 1 / `part` of
            the run's time. 0 for no such snapshots. A snapshot costs about twice the standstill,
            because the processes then copy each page that they write.
        every: Number of ticks between additional periodic snapshots, 0 for none.
        at: Tick before which one additional snapshot is taken, None for none.
    """

    part: int = 80
    every: int = 0
    at: int | None = None


@dataclass(frozen=True)
class Continuation:
    """Point from which a rack in lockstep continues: its crate's last snapshot up to `tick`.

    A task continues with its state in the snapshot, even if the settings of its level have changed.
    If anything else in its wiring has changed, a new process is started, which reads the restored
    mailboxes.

    Attributes:
        tick: Latest permitted tick of the snapshot.
        faults: Number of faults of the config that the snapshot's fault table already contains.
        commands: Number of commands of the config that its operator table already contains.
        losses: Boards that were lost in the continued run, each with the tick of the loss.
    """

    tick: int
    faults: int = 0
    commands: int = 0
    losses: tuple[tuple[str, int], ...] = ()


@dataclass(frozen=True)
class Scheduling:
    """Scheduler of a task or the clock, and what it needs.

    Attributes:
        core: The core that the config requests.
        priority: The fixed priority that the config requests.
        scheduler: Its scheduler at the launch.
        is_critical: Whether maximum urgency first runs it before others.
        cost_ns: In lockstep, simulated processor time of a cycle or plan. 0 if it takes none.
        switch_ns: Simulated time of the two context switches of a cycle or plan.
        locked_ns: Part of `cost_ns`, at its end, which runs at priority `ceiling`.
        ceiling: Priority of the executor that must wait for a plan update. 0 if none must.
        reservation: In real time, processor time to reserve under earliest deadline first. None
            without a budget.
        clocks: The same of the clock if it is on this core.
    """

    core: int
    priority: int
    scheduler: Scheduler
    is_critical: bool
    cost_ns: int
    switch_ns: int
    locked_ns: int
    ceiling: int
    reservation: Reservation | None
    clocks: Reservation | None


@dataclass(frozen=True)
class TaskWiring:
    """Wiring of one task.

    Attributes:
        task: Name of the task.
        target: Class of its executor or planner, as "package.module:Class".
        inputs: Mailboxes of each input port.
        outputs: Mailbox of each output port.
        context: Context of the level.
        critical_priority: SCHED_FIFO priority of a tightly coupled planner while it writes a
            plan. 0 to keep its ordinary priority.
        guards_clock: True if the task checks the clock, as one of the fastest tasks.
        sent: Output ports whose queues the level fills itself, by calling `send`. Any other
            queue gets one message per cycle.
        fails_self_test: True if the config injects a failed self-test.
        entries: Recorded messages for an adapter in a replay, otherwise None.
        transfer: Minimum processor time of bus accesses.
        exchange: Rules for input ports that are read at a different rate or asynchronously. If
            there are any, the task writes its mailbox `<board>.exchange`.
        scheduling: How the task competes for its core. None for a fixed priority that stays.
        budget_ns: Budgeted processor time of a cycle or plan. 0 without a budget.
        compares: True if a standby raises an alarm when its messages differ.
        votes: True if the copy that differs from the two others is taken out.
    """

    task: str
    target: str
    inputs: Mapping[str, Source]
    outputs: Mapping[str, str]
    context: LevelContext
    critical_priority: int
    guards_clock: bool
    sent: tuple[str, ...]
    fails_self_test: bool
    entries: RecordedEntries | None
    transfer: BusTimes
    exchange: Mapping[str, ExchangeSpec]
    scheduling: Scheduling | None
    budget_ns: int
    compares: bool
    votes: bool


@dataclass(frozen=True)
class HostWiring:
    """Wiring of one host board.

    Attributes:
        board: Name of the board.
        target: Class of its program.
        inputs: Mailbox of each input port.
        outputs: Mailbox of each output port.
        context: Context of the program.
        is_external: True if the rack does not start the board, because `rack prompt` runs it.
        computing: In lockstep, simulated time in ticks that the program takes to compute after
            each wait.
    """

    board: str
    target: str
    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    context: LevelContext
    is_external: bool
    computing: int


@dataclass(frozen=True)
class ClockWiring:
    """Wiring of the clock's board. Times are in ticks unless stated otherwise.

    Attributes:
        lockstep: True for lockstep, False for real time.
        period_ns: Wall-clock time of a tick, including the speed factor.
        stop_tick: Tick at which the run ends, 0 for never.
        ends_run: Status mailbox in which state done or error ends the run. None if no level ends
            the run.
        linger: Time from that status to the end of the run.
        silent: The run also ends if `ends_run` has no new message for this time, unless its
            writer is lost.
        longest: The run also ends after this time. 0 for no limit.
        history: Number of ticks by which the clock may be ahead of a recorder in lockstep.
        core: Processor core.
        priority: SCHED_FIFO priority.
        keeps_awake: True if idle cores must not sleep.
        restart_ticks: In lockstep, time from the loss of a board until it rejoins.
        on_loss: Stop required of the arm while a task is lost, keyed by task.
        reservation: Processor time to reserve instead of a priority, None for none.
        schedulings: How tasks compete for their cores, by task. Empty if the config names no
            scheduler. On simulated cores also planners and the clock.
        copy: Number of this process among those that can run the clock, None if it is the only one.
    """

    lockstep: bool
    period_ns: int
    stop_tick: int
    ends_run: str | None
    linger: int
    silent: int
    longest: int
    history: int
    core: int
    priority: int
    keeps_awake: bool
    restart_ticks: int
    on_loss: Mapping[str, Demand]
    reservation: Reservation | None
    schedulings: Mapping[str, Scheduling]
    copy: int | None
