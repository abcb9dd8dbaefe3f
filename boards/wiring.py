"""Plain data that the Rack sends to the crate: everything that a process needs to run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rack.backplane.layout import ExchangeSpec
from rack.backplane.process import Reservation
from rack.backplane.words import Demand
from rack.levels.level import LevelContext

Source = str | Mapping[str, str]
"""What a port reads: a mailbox, or mailboxes by board."""


Rows = Sequence[tuple[int, int, bytes]]
"""Messages of a recorded run, oldest first: the tick at which each was written, that of the
information on which it rests, and its bytes. Of a mailbox that repeats itself only the changes."""
Entries = Mapping[str, Rows]
"""What an adapter wrote in a recorded run, by port."""


def mailboxes_of(source: Source) -> tuple[str, ...]:
    """Return the mailboxes of a port."""
    return (source,) if isinstance(source, str) else tuple(source.values())


@dataclass(frozen=True)
class BusTimes:
    """A slower bus: minimum processor time of each kind of access, ns; see
    `[board.<name>.transfer]`.
    """

    read_ns: int = 0
    write_ns: int = 0
    exchange_ns: int = 0
    update_ns: int = 0


@dataclass(frozen=True)
class SnapshotPolicy:
    """Snapshots that a rack in lockstep takes: the standstill for them is one part in `part` of its
    time; 0: it does not matter. Besides, there is one each `every` ticks, unless that is 0, and one
    before the tick `at`, if that is given.
    """

    part: int = 40
    every: int = 0
    at: int | None = None


@dataclass(frozen=True)
class Continuation:
    """Where a rack in lockstep goes on from: the last snapshot of its crate at `tick` or before.

    The snapshot has the first `faults` and `commands` of the config in its tables. `losses` are
    the boards lost in the run that it continues, and when. A task goes on as it is there, with
    other settings perhaps. If it is wired otherwise it starts anew, from what its mailboxes hold.
    """

    tick: int
    faults: int = 0
    commands: int = 0
    losses: tuple[tuple[str, int], ...] = ()


@dataclass(frozen=True)
class TaskWiring:
    """One task: its class `target`, as "package.module:Class", and the mailboxes of each port.

    `critical_priority`: SCHED_FIFO priority of a tightly coupled planner during its plan update.
    `guards_clock`: the task is one of the fastest and watches the clock. `sent`: the ports whose
    messages the level sends itself. `fails_self_test`: a fault in the config. `entries`: for an
    adapter in a replay. `exchange`: the ports that are not simply read in every cycle; it makes the
    task write its mailbox `<board>.exchange`. `reservation`: asked for in place of a priority.
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
    entries: Entries | None
    transfer: BusTimes
    exchange: Mapping[str, ExchangeSpec]
    reservation: Reservation | None


@dataclass(frozen=True)
class HostWiring:
    """One host board: its program's class, and the mailbox of each port. External: a prompt runs
    it, not the rack.

    `computing`: simulated time for which it computes after each wait, in lockstep, ticks.
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
    """The clock's board: the course of a run in time. `period_ns` is wall-clock time, including the
    speed factor.

    All other times are ticks. The run ends at `stop_tick` (0: never), or `linger` after the status
    mailbox `ends_run` reports done or error, or if its writer, not lost, has written nothing for
    `silent`. In lockstep the clock is at most `history` ahead of a recorder, and a lost board
    rejoins `restart_ticks` after its loss. `on_loss`: the demand on the arm while a task is lost.
    `keeps_awake`: no core sleeps while it is idle. `reservation`: as of a task.
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
