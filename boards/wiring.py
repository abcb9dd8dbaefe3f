"""Plain data that the Rack sends to the crate: everything that a process needs to run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rack.backplane.layout import ExchangeSpec
from rack.backplane.process import Reservation
from rack.backplane.words import Demand
from rack.levels.level import LevelContext

Source = str | Mapping[str, str]
"""Source of a port: a mailbox, or mailboxes by board."""


EntityRows = Sequence[tuple[int, int, bytes]]
"""Messages of a mailbox in a recorded run, oldest first.

Each row has the tick at which the message was written, the tick of the information on which it
depends, and its bytes. A mailbox whose messages repeat has only rows for changes.
"""
ExchangedEntries = Mapping[str, EntityRows]
"""Messages that an adapter wrote in a recorded run, by port."""


def list_mailboxes(source: Source) -> tuple[str, ...]:
    """Return the mailboxes of a port."""
    return (source,) if isinstance(source, str) else tuple(source.values())


@dataclass(frozen=True)
class BusTimes:
    """Minimum processor time of each kind of access in ns, to emulate a slower bus.

    See `[board.<name>.transfer]`.
    """

    read_ns: int = 0
    write_ns: int = 0
    exchange_ns: int = 0
    update_ns: int = 0


@dataclass(frozen=True)
class SnapshotPolicy:
    """Policy for the snapshots of a rack in lockstep.

    Attributes:
        part: Snapshots take at most 1 / `part` of the run's time. 0 for no snapshots by this
            rule.
        every: Ticks between additional snapshots, 0 for none.
        at: Tick before which one more snapshot is taken, None for none.
    """

    part: int = 40
    every: int = 0
    at: int | None = None


@dataclass(frozen=True)
class Continuation:
    """Point from which a rack in lockstep continues: its crate's last snapshot by `tick`.

    A task continues as it was in the snapshot, possibly with other settings. If its wiring differs,
    it starts afresh with the content of its mailboxes.

    Attributes:
        tick: Latest permitted tick of the snapshot.
        faults: Number of faults of the config that are in the snapshot's table.
        commands: Number of commands of the config that are in the snapshot's table.
        losses: Boards lost in the run that it continues, with the ticks.
    """

    tick: int
    faults: int = 0
    commands: int = 0
    losses: tuple[tuple[str, int], ...] = ()


@dataclass(frozen=True)
class TaskWiring:
    """Wiring of one task.

    Attributes:
        task: Name of the task.
        target: Class of its executor or planner, as "package.module:Class".
        inputs: Mailboxes of each input port.
        outputs: Mailbox of each output port.
        context: Context of the level.
        critical_priority: SCHED_FIFO priority of a tightly coupled planner during its plan
            update.
        guards_clock: True for one of the fastest tasks, which watch the clock.
        sent: Ports whose messages the level sends itself.
        fails_self_test: True if the config injects a failed self-test.
        entries: Recorded messages for an adapter in a replay.
        transfer: Processor time of accesses.
        exchange: Ports that are not simply read in every cycle. If there are any, the task
            writes its mailbox `<board>.exchange`.
        reservation: Processor time requested instead of a priority.
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
    entries: ExchangedEntries | None
    transfer: BusTimes
    exchange: Mapping[str, ExchangeSpec]
    reservation: Reservation | None


@dataclass(frozen=True)
class HostWiring:
    """Wiring of one host board.

    Attributes:
        board: Name of the board.
        target: Class of its program.
        inputs: Mailbox of each input port.
        outputs: Mailbox of each output port.
        context: Context of the program.
        is_external: True if a prompt runs the board, not the rack.
        computing: Simulated time for which it computes after each wait in lockstep, in ticks.
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
        ends_run: Status mailbox whose report of done or error ends the run.
        linger: Time from that report to the end of the run.
        silent: Time without a message from the writer of `ends_run`, if it is not lost, that
            ends the run.
        history: Maximum lead of the clock over a recorder in lockstep.
        core: Processor core.
        priority: SCHED_FIFO priority.
        keeps_awake: True if idle cores must not sleep.
        restart_ticks: Time from the loss of a board to its rejoining in lockstep.
        on_loss: Demand on the arm while a task is lost.
        reservation: Processor time requested instead of a priority.
    """

    lockstep: bool
    period_ns: int
    stop_tick: int
    ends_run: str | None
    linger: int
    silent: int
    history: int
    core: int
    priority: int
    keeps_awake: bool
    restart_ticks: int
    on_loss: Mapping[str, Demand]
    reservation: Reservation | None
