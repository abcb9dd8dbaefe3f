"""The board in slot 1: the system controller, which runs the clock.

At every tick it releases the tasks, begins and ends faults, issues operators' commands, lets
restarted boards rejoin, and decides whether the arm must stop or brake.
"""

from __future__ import annotations

import os
import sys
import time
from importlib import import_module
from typing import TYPE_CHECKING

from rack.backplane.address_map import CLOCK
from rack.backplane.checked import to_enum
from rack.backplane.clock.driver import ClockDriver, RealtimeDriver
from rack.backplane.clock.lockstep import LockstepDriver
from rack.backplane.clock.released_task import ReleasedTask
from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.mailbox.protocols import open_observer, open_writer
from rack.backplane.message import State
from rack.backplane.operator_table import Client, OperatorTable, RequestEntry, RequestStage
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import PEER, Alarm, AlarmWriter
from rack.backplane.words import Block, Demand, HandOver, Run, System, is_switched_on
from rack.boards.faults.clock_board import FaultStage
from rack.boards.operator import build_hold_command, find_level
from rack.boards.run.copying import Copier
from rack.boards.run.snapshots import ClockCopies
from rack.boards.wiring import ClockWiring
from rack.levels.operator import PASSING_OPERATIONS, Answer, Operation

if TYPE_CHECKING:
    from rack.boards.run.hand_over import HandOverDirector
    from rack.boards.run.scheduling import SchedulerChanges
    from rack.boards.run.simulated_cores import SimulatedCores

START_DELAY_NS = 20_000_000
"""Time from the start of the clock's board to tick 0, so that the start-up delays no tick."""
OPERATOR_TIMEOUT_NS = 1_000_000_000
"""Time without a heartbeat after which a lease is released, because its client is assumed dead.

It is converted to ticks. In lockstep, heartbeats are not checked.
"""


class SystemController:
    """Work of the clock's board at every tick, apart from releasing tasks.

    Implements `rack.backplane.clock.driver.Controller`.

    Attributes:
        cores: Simulated cores, in lockstep if computing takes simulated time.
    """

    def __init__(
        self, segment: Segment, wiring: ClockWiring, driver: ClockDriver, end_of_run: EndOfRun
    ) -> None:
        self._end_of_run = end_of_run
        self._words = segment.words
        self._wiring = wiring
        self._driver = driver
        self._faults = FaultStage(segment, driver)
        self._desk = OperatorCommandIssuer(segment, driver.alarms)
        if wiring.schedulings:
            # Import it only in racks that name a scheduler.
            self._desk.changes = import_module("rack.boards.run.scheduling").SchedulerChanges(
                segment, driver.tasks, wiring.schedulings, driver.alarms
            )
        if segment.layout.replicated_tasks:
            # Import it only in racks that have standbys.
            hand_over = import_module("rack.boards.run.hand_over")
            self._desk.hand_overs = hand_over.HandOverDirector(segment, driver)
        self._settled: tuple[int, int, int, int] | None = None
        self._demand = to_enum(Demand, self._words[System.DEMAND])
        self.cores: SimulatedCores | None = None

    def begin_tick(self, tick: int) -> None:
        """Do the work that is due before the tasks of `tick` are released."""
        words = self._words
        faults = self._faults
        desk = self._desk
        if tick >= faults.next_tick or words[System.INJECTED] != faults.injected:
            faults.advance_faults(tick)
        if tick >= desk.next_tick or words[System.REQUESTED] != desk.requested:
            desk.issue_due_commands(tick)
        if desk.hand_overs is not None:
            desk.hand_overs.check_active_copies()
        if self._settled != (
            words[System.LOSSES],
            self._driver.watchdog.losses,
            words[System.EMERGENCY_STOP],
            words[System.PEER_STOP],
        ):
            self._handle_losses(tick)

    def finish_release(self, tick: int) -> None:
        """Do the work that is due after the tasks of `tick` have been released."""
        self._faults.act_within_tick(tick)
        if self.cores is not None:
            self.cores.run_tick(tick)

    def find_next_work_tick(self, tick: int) -> int:
        """Return the first tick after `tick` at which `begin_tick` has work or the run may end."""
        if self._settled is None:
            return tick + 1
        return min(self._faults.next_tick, self._desk.next_tick, self._end_of_run.next_tick)

    def _handle_losses(self, tick: int) -> None:
        """React to lost boards, to the emergency stop and to the loss of other racks.

        Restarted boards rejoin. A board that will not be restarted causes the emergency stop. The
        losses that remain determine whether the arm must stop or brake, which is published in
        `System.DEMAND`.
        """
        words = self._words
        seen = words[System.LOSSES], self._driver.watchdog.losses
        processes = self._driver.processes
        hand_overs = self._desk.hand_overs
        for task in processes:
            if task.is_lost:
                self._handle_loss(task, tick)
        lost = [task for task in processes if task.is_lost]
        # Read these words before acting on them. A later change is handled at the next tick.
        emergency = words[System.EMERGENCY_STOP]
        peer = words[System.PEER_STOP]
        demands = [
            (self._wiring.on_loss.get(task.spec.name, Demand.NONE), task.index)
            for task in lost
            if hand_overs is None or not hand_overs.is_served(task)
        ]
        if emergency:
            demands.append((Demand.BRAKE, -1))
        if is_switched_on(peer, tick):
            demands.append((Demand.STOP, PEER))
        demand, subject = max(demands, default=(Demand.NONE, -1))
        if demand != self._demand:
            self._driver.wait_until_settled()
            self._demand = demand
            words[System.DEMAND] = demand
            self._driver.alarms.raise_alarm(tick, Alarm.DEMAND, subject, demand)
        # Call this again at the next tick while a board is lost, a switch is set for a later tick,
        # or the crate is in the middle of recording a loss.
        is_settled = not lost and peer >> 1 <= tick and seen[0] % 2 == 0
        self._settled = (*seen, emergency, peer) if is_settled else None

    def _handle_loss(self, task: ReleasedTask, tick: int) -> None:
        """Let a restarted board rejoin, or handle a board that will not be restarted.

        In lockstep, a board rejoins a fixed number of ticks after its loss. A board that will not
        be restarted causes the emergency stop and then the end of the run. A host board that will
        not be restarted is treated as rejoined, and its bus adapter reports the loss.
        """
        if self._wiring.lockstep and tick < task.lost_tick + self._wiring.restart_ticks:
            return
        self._driver.await_state(task, lambda: task.is_ready or task.is_given_up)
        if task.is_ready:
            away = tick - task.lost_tick
            self._driver.wait_until_settled()
            task.admit_new_process()
            self._driver.alarms.raise_alarm(tick, Alarm.REJOINED, task.index, away)
        elif task.is_given_up and task.spec.role == "host":
            # From this tick on, the bus adapter of the host board reports the loss.
            self._driver.wait_until_settled()
            task.admit_new_process()
        elif task.is_given_up:
            # Set the latch even if it is already set, as it is before the start.
            self._words[System.EMERGENCY_STOP] = 1
            # Leave the arm time to come to rest before the run ends.
            ends = tick + self._wiring.linger
            self._words[System.STOP_TICK] = min(self._words[System.STOP_TICK] or ends, ends)


class OperatorCommandIssuer:
    """Issues operators' commands at the beginning of a tick, before any task is released.

    A command is issued by publishing it in its level's operator mailbox.

    Attributes:
        requested: Number of requests that the operator table had when it was last read.
        next_tick: First tick with work to do, unless there are new requests.
        changes: Changes of schedulers. None if the rack names no scheduler.
        hand_overs: Hand-overs to standbys. None if the rack has none.
    """

    def __init__(self, segment: Segment, alarms: AlarmWriter) -> None:
        self._words = segment.words
        self._alarms = alarms
        self.changes: SchedulerChanges | None = None
        self.hand_overs: HandOverDirector | None = None
        self._layout = segment.layout
        self._table = OperatorTable(segment)
        self._clock = SystemClock(segment)
        boxes = segment.layout.mailboxes
        self._writers = {
            at: open_writer(segment, box.name)
            for at, box in enumerate(boxes)
            if box.writer == CLOCK
        }
        answering = {box.name for box in boxes if "order" in {field.name for field in box.fields}}
        self._statuses = {
            at: open_observer(segment, name)
            for at in self._writers
            if (name := f"{boxes[at].name.partition('.')[0]}.status") in answering
        }
        self.requested = -1
        self.next_tick = 0
        self._waiting: list[RequestEntry] = []
        self._leased: list[RequestEntry] = []
        self._newest: dict[int, int] = {}
        """Serial of the newest command that replaces earlier ones, by mailbox."""
        # In lockstep a tick has no fixed length in real time, so silence is not checked.
        self._silent = sys.maxsize
        if not self._words[System.LOCKSTEP]:
            self._silent = OPERATOR_TIMEOUT_NS // segment.layout.clock_ns

    def issue_due_commands(self, tick: int) -> None:
        """Check all leases, then issue all commands due at `tick`."""
        if self._words[System.REQUESTED] != self.requested:
            self.requested = self._words[System.REQUESTED]
            self._waiting = self._table.list_waiting()
            self._leased = self._table.list_leased()
        for entry in list(self._leased):
            self._check_lease(entry, tick)
        for entry in [entry for entry in self._waiting if entry.tick <= tick]:
            self._waiting.remove(entry)
            # First set the tick, then check that the request is still waiting. A client that
            # withdraws its request uses the opposite order.
            entry.given_tick = tick
            if self._table.is_waiting(entry):
                self._issue_command(entry, tick)
            else:
                entry.given_tick = -1
        due = [tick + 1] if self._leased else [entry.tick for entry in self._waiting]
        self.next_tick = min(due, default=sys.maxsize)

    def _issue_command(self, entry: RequestEntry, tick: int) -> None:
        """Issue the command of a waiting request."""
        writer = self._writers[entry.mailbox]
        if not entry.serial:
            # If the clock dies after this line, its successor issues the command again with the
            # same serial.
            self._words[System.COMMANDED] += 1
            entry.serial = self._words[System.COMMANDED]
        message = writer.message
        message.raw[:] = entry.message[: len(message.raw)]
        message.id = entry.serial
        writer.write(tick, self._clock.compute_tick())
        if message.what == Operation.SCHEDULE and self.changes is not None:
            self.changes.change_scheduler(find_level(entry, self._layout), message.name, tick)
        entry.stage = RequestStage.GIVEN
        if message.what == Operation.SWITCH and self.hand_overs is not None:
            self.hand_overs.switch_copy(find_level(entry, self._layout))
        if message.what not in PASSING_OPERATIONS:
            self._newest[entry.mailbox] = message.id
        self._alarms.raise_alarm(tick, Alarm.COMMANDED, entry.index, entry.serial)
        if entry.client == Client.LEASES:
            self._leased.append(entry)

    def _check_lease(self, entry: RequestEntry, tick: int) -> None:
        """Release a lease that has ended, and make the level hold if the client is dead or silent.

        A lease ends without further effect when a newer command replaces the leased one, or when
        the level refuses it.

        Args:
            entry: Entry of a command that was issued under a lease.
            tick: Current tick.
        """
        if self._is_superseded(entry):
            self._table.release_lease(entry)
        if entry.client == Client.LEASES:
            heard = max(entry.given_tick, entry.heard)
            if self._table.is_client_alive(entry) and tick - heard <= self._silent:
                return
            # Issue the hold command directly, without a request, because the table may be full.
            writer = self._writers[entry.mailbox]
            self._words[System.COMMANDED] += 1
            writer.message.raw[:] = build_hold_command(self._layout.mailboxes[entry.mailbox]).raw
            writer.message.id = self._words[System.COMMANDED]
            writer.write(tick, self._clock.compute_tick())
            self._table.release_lease(entry)
            self._alarms.raise_alarm(tick, Alarm.OPERATOR_GONE, entry.index, writer.message.id)
        self._leased.remove(entry)

    def _is_superseded(self, entry: RequestEntry) -> bool:
        """Check whether a level has refused a leased command, or accepted one that replaces it."""
        mailbox = entry.mailbox
        serial = entry.serial
        newest = self._newest.get(mailbox, 0)
        if mailbox not in self._statuses:
            return newest > serial
        status = self._statuses[mailbox].peek()
        if not status.has_message:
            return False
        order = status.message.order
        if order == serial:
            return bool(status.message.answer == Answer.REFUSED)
        accepted = status.message.answer in (Answer.TAKEN, Answer.DONE)
        return bool(newest > serial and order == newest and accepted)


class EndOfRun:
    """Decides at which tick a run ends, regardless of wall-clock time.

    A run ends at the tick that its config gives. Without such a tick, it ends a fixed time after
    its task: after the status of the level that ends the run reports done or error, or has been
    missing for too long, or after the longest permitted time in lockstep. The end of the task is
    determined even if the config gives a tick, because a run that continues this one may end with
    the task.
    """

    def __init__(self, segment: Segment, wiring: ClockWiring) -> None:
        self._stop_tick = wiring.stop_tick
        self._task_ends: int | None = None
        self._linger = wiring.linger
        self._reader = open_observer(segment, wiring.ends_run) if wiring.ends_run else None
        self._silent = wiring.silent
        self._longest = wiring.longest or sys.maxsize
        self._heard: int | None = None
        # Under a tick-based protocol, messages become visible only at ticks of the mailbox's grid.
        self._every = 1
        self._phase = 0
        if self._reader is not None:
            self._writer = segment.get_block(self._reader.spec.writer)
            if self._reader.spec.is_tick_based:
                self._every = self._reader.spec.every
                self._phase = self._reader.spec.phase
        self._next = 0

    @property
    def next_tick(self) -> int:
        """Next tick at which the decision may change."""
        if self._reader is None or self._task_ends is not None:
            return sys.maxsize
        return self._next + 1

    def __call__(self, tick: int) -> int | None:
        """Return the tick before which the run stops, or None while that is not known.

        Args:
            tick: Tick that is about to begin. Messages are read as of the tick before it.
        """
        final = tick - 1
        if final >= self._next and self._task_ends is None and self._reader is not None:
            boundary = final - (final - self._phase) % self._every
            self._next = boundary + self._every
            reading = self._reader.read(boundary)
            if reading.is_new or self._heard is None or self._writer[Block.LOST]:
                self._heard = boundary
            is_over = reading.is_new and reading.message.state in (State.DONE, State.ERROR)
            if is_over or boundary - self._heard >= self._silent or tick >= self._longest:
                self._task_ends = max(boundary + self._linger, tick)
        return self._stop_tick or self._task_ends


def run_clock(segment: Segment, wiring: ClockWiring, attention: int, copier: Copier | None) -> None:
    """Run the clock until the run is over. A restarted clock continues on the existing grid.

    Args:
        segment: Memory of the rack.
        wiring: Wiring of the clock.
        attention: eventfd that wakes the Rack when the clock raises an alarm.
        copier: Forks the copies of the clock for snapshots. None if no snapshots are taken.
    """
    words = segment.words
    was_run = words[System.CLOCK_PID] != 0
    words[System.CLOCK_PID] = os.getpid()
    alarms = AlarmWriter(segment, CLOCK, attention)
    if words[System.STATE] != Run.RUNNING:
        words[System.EPOCH_NS] = time.monotonic_ns() + START_DELAY_NS
    else:
        now = SystemClock(segment).compute_tick()
        newest = words[System.TICK]
        alarms.raise_alarm(now, Alarm.REJOINED, value=now - newest, since=newest)
        if was_run and wiring.copy is not None:
            # A standby of the clock waits whenever the clock runs, so this is another copy.
            alarms.raise_alarm(now, Alarm.TAKEN_OVER, -1 - wiring.copy, HandOver.LOST)
    end_of_run = EndOfRun(segment, wiring)
    driver: ClockDriver
    if wiring.lockstep:
        layout = segment.layout
        one_at_a_time = not all(mailbox.is_repeatable for mailbox in layout.mailboxes)
        one_at_a_time |= any(len(layout.find_pacers(host)) > 1 for host in layout.hosts)
        driver = LockstepDriver(segment, end_of_run, one_at_a_time, wiring.history, alarms)
        # A board that is interrupted may miss releases at any tick.
        driver.permits_batches &= all(mailbox.interrupt is None for mailbox in layout.mailboxes)
        if copier is not None:
            driver.snapshot = ClockCopies(segment, driver, copier)
    else:
        driver = RealtimeDriver(segment, end_of_run, alarms)
    driver.controller = controller = SystemController(segment, wiring, driver, end_of_run)
    if isinstance(driver, LockstepDriver) and any(s.cost_ns for s in wiring.schedulings.values()):
        driver.permits_batches = False
        controller.cores = import_module("rack.boards.run.simulated_cores").SimulatedCores(
            wiring.schedulings, driver, segment.layout.clock_ns
        )
    driver.run()
