"""A task on its board, the clock guard of the fastest tasks, and the board's interrupt handler."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from importlib import import_module
from time import process_time_ns
from typing import ClassVar, ParamSpec, TypeVar

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.clock.wake import NextCycle
from rack.backplane.mailbox.inbox import MAX_PREEMPTED_CYCLES, Work
from rack.backplane.mailbox.interrupt import BoardInbox, open_inbox
from rack.backplane.process import busy_wait_until
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter, Episodes
from rack.backplane.words import Block, System, TaskState
from rack.boards.faults.tasks import TaskFaults
from rack.boards.run.ports import InputPorts, OutputPorts
from rack.boards.run.simulated_time import SimulatedTime
from rack.boards.run.stopwatch import Stopwatch
from rack.boards.wiring import TaskWiring
from rack.levels.level import Executor, Planner

PUNCTUAL_TICKS = 20
"""Number of ticks without a late one after which the next late tick raises an alarm again."""
_P = ParamSpec("_P")
_R = TypeVar("_R")


class Task(ABC):
    """A task: runs a level's executor or planner with ports, clock, stopwatch and faults.

    Attributes:
        spec: Description of the task from the layout.
        block: Control block of the task.
        level: The executor or planner.
        simulated: Simulated times of the cycles, in lockstep.
        serve: Function that serves the board's interrupts in each cycle. None if nothing
            interrupts the board, or another of its tasks serves the interrupts.
    """

    outputs_class: ClassVar[type[OutputPorts]] = OutputPorts

    def __init__(
        self,
        segment: Segment,
        wiring: TaskWiring,
        level: Executor | Planner,
        attention: int | None,
    ) -> None:
        self.spec = spec = segment.layout.find_task(wiring.task)
        self.block = segment.get_block(wiring.task)
        self.words = segment.words
        self.level = level
        self.clock = SystemClock(segment)
        self.alarms = AlarmWriter(segment, wiring.task, attention)
        self.next_cycle = NextCycle(
            segment, wiring.task, self.alarms if wiring.guards_clock else None
        )
        inbox = open_inbox(segment, wiring.task)
        self.serve: Callable[[int], None] | None = None
        handler = None
        # The first task of a board serves its interrupts.
        if inbox is not None and wiring.task == segment.layout.find_interrupt_task(spec.slot):
            handler = InterruptHandler(segment, wiring, inbox, self.alarms)
            self.serve = handler.serve_messages
        self.inputs = InputPorts(
            segment,
            level,
            wiring.inputs,
            self.alarms,
            f"{spec.board}.plan",
            exchange=wiring.exchange,
            inbox=inbox,
        )
        self.inputs.task.now = self.clock.compute_tick
        self.outputs = self.outputs_class(
            segment, level, wiring.outputs, self.alarms, self.inputs, wiring.sent
        )
        self.stopwatch = Stopwatch(segment, wiring.task, self.inputs, self.outputs)
        self.faults = TaskFaults(segment, spec, self.outputs.apply_faults, level)
        self.simulated = SimulatedTime(segment, spec)
        # Without a budget, computing takes no simulated time that a handler could preempt.
        if handler is not None and (wiring.budget_ns or not self.clock.is_lockstep):
            self.simulated.steps.append(handler.preempt_computing)
        if wiring.scheduling is not None and wiring.scheduling.cost_ns:
            # Import it only in racks that need it.
            # The step of an interrupt handler includes the budget of the cycle.
            cost_ns = 0 if handler else wiring.scheduling.cost_ns
            simulated_cores = import_module("rack.boards.run.simulated_cores")
            self.simulated.steps.append(partial(simulated_cores.await_job_end, self, cost_ns))
        self._generation = 0

    def wait_until_next_cycle(self) -> int | None:
        """Wait for the next release and return its tick. Returns None if the run is over.

        Faults of the task begin and end during this call, between two cycles.
        """
        while (tick := self.next_cycle.wait()) is not None:
            if self.words[System.FAULTS] == self._generation:
                return tick
            faults = self.faults
            self._generation = faults.refresh_faults(tick)
            if faults.taken_until <= tick:
                if self.clock.is_lockstep:
                    # Faults extend the computing before any other step.
                    extend = faults.extend_computing
                    others = [step for step in self.simulated.steps if step != extend]
                    self.simulated.steps = [extend, *others] if faults.loads else others
                    late_ticks = faults.find_lateness(tick)
                    late_ns = int(late_ticks * self.clock.period_ns)
                    self.simulated.late_ns = self.stopwatch.late_ns = late_ns
                    self.level.late_s = late_ticks * self.level.context.tick_s
                return tick
            # The core is taken: the task gets its newest release once the core is free again.
            self.next_cycle.return_release(tick)
            self.next_cycle.wait_for_tick(faults.taken_until)
        return None

    def end_computing(self, tick: int, deadline: int) -> int | None:
        """In lockstep, wait until the clock has begun the tick in which the computing ends.

        Args:
            tick: Release tick of the cycle.
            deadline: Tick before which the cycle must end.

        Returns:
            That tick. None if the messages of the cycle are the same without a wait.
        """
        end_tick = self.simulated.find_end_tick(tick, deadline)
        if end_tick is not None:
            self.next_cycle.wait_for_tick(end_tick)
        return end_tick

    def run(self) -> None:
        """Cycle until the run is over."""
        self.block[Block.STATE] = TaskState.RUNNING
        self.stopwatch.start_counting()
        while (tick := self.wait_until_next_cycle()) is not None:
            self.cycle(tick)
        self.stopwatch.update_bus_counters()

    @abstractmethod
    def cycle(self, tick: int) -> None:
        """Run the cycle released at `tick`."""


class ClockGuard:
    """Reports ticks that the clock has skipped or begun late, for one of the fastest tasks.

    Even the fastest task need not cycle in every tick. Most skipped ticks then neither cost it a
    release nor delay its cycles, so it learns of skipped ticks from the clock's count.

    Attributes:
        reported: Number of skipped ticks that this task has reported, including earlier
            processes.
    """

    def __init__(self, segment: Segment, alarms: AlarmWriter, block: memoryview) -> None:
        self._words = segment.words
        self._block = block
        self._clock = SystemClock(segment)
        self._alarms = alarms
        self._late_ns = self._clock.period_ns // 2
        self.reported = self._block[Block.CLOCK_SKIPPED]
        self._quiet_from = 0

    def report_skipped(self, tick: int) -> None:
        """Report the ticks that the clock has skipped since the last report.

        Args:
            tick: Release tick of the cycle. Ticks skipped after it are left to the next cycle.
        """
        words = self._words
        since = words[System.SKIPPED_FROM]
        # A cycle may begin so late that the clock has skipped ticks after its release. The next
        # cycle reports them.
        if tick >= since:
            counted = words[System.CLOCK_SKIPPED]
            self._alarms.raise_alarm(
                tick, Alarm.CLOCK_SKIPPED, value=counted - self.reported, since=since
            )
            self.reported = self._block[Block.CLOCK_SKIPPED] = counted

    def check_release(self, tick: int, late_ns: int) -> None:
        """Raise an alarm, once per episode, if the cycle began late because the clock was late.

        Args:
            tick: Release tick of the cycle.
            late_ns: In lockstep, lateness of the clock.
        """
        words = self._words
        if not self._clock.is_lockstep:
            late_ns = words[System.TICK_NS] - self._clock.compute_time_ns(tick)
            # Check this after reading the time, which belongs to this tick only if the clock has
            # not advanced since.
            if words[System.TICK] != tick:
                return
        if late_ns > self._late_ns:
            if tick >= self._quiet_from:
                self._alarms.raise_alarm(tick, Alarm.CLOCK_LATE, value=late_ns)
            self._quiet_from = tick + PUNCTUAL_TICKS


class InterruptHandler:
    """Interrupt handler of a board, under protocol interrupt.

    It counts interrupts, reports lost ones, and takes processor time. On the original boards the
    handler ran whenever a message arrived, and preempted what the board computed. In this program
    the first task of the board takes the time of the handler at the end of its computation, before
    it writes: for the messages that were being served at the release, and for those that have
    arrived since then. In lockstep this is simulated time, in which the cycle takes its budget, and
    messages arrive when the responses of their writers say. Between two computations the handler
    takes the time of nothing.
    """

    def __init__(
        self, segment: Segment, wiring: TaskWiring, inbox: BoardInbox, alarms: AlarmWriter
    ) -> None:
        self._inbox = inbox
        self._block = segment.get_block(wiring.task)
        self._clock = clock = SystemClock(segment)
        self._clock_ns = segment.layout.clock_ns
        self._budget_ns = wiring.budget_ns
        every = segment.layout.find_task(wiring.task).every
        self._longest_ns = MAX_PREEMPTED_CYCLES * every * self._clock_ns
        self._sources = [source for source in inbox.sources if source.is_periodic]
        self._lines = [
            (line, Episodes(segment, name, alarms)) for name, line in inbox.lines.items()
        ]
        # Interrupts before the start of this process are not counted and take no time.
        inbox.advance_to(clock.tick)
        inbox.inbox.most_waiting = 0
        self._served = inbox.count
        # Time of the handler that has passed or has been taken.
        self._taken_ns = inbox.accepted_ns
        self._lost = [line.lost for line in inbox.lines.values()]
        self._cycles = 0

    def serve_messages(self, tick: int) -> None:
        """Serve all messages that have arrived up to the release at `tick`."""
        inbox = self._inbox
        self._cycles += 1
        inbox.advance_to(tick)
        self._taken_ns = inbox.accepted_ns - max(0, inbox.inbox.free_ns - tick * self._clock_ns)
        if inbox.count != self._served:
            self._block[Block.INTERRUPTS] += inbox.count - self._served
            self._served = inbox.count
        if inbox.inbox.most_waiting > self._block[Block.INTERRUPTS_WAITING]:
            self._block[Block.INTERRUPTS_WAITING] = inbox.inbox.most_waiting
        if inbox.inbox.lost != sum(self._lost):
            # Count the messages lost in the inbox, and raise an alarm for each mailbox.
            for at, (line, episodes) in enumerate(self._lines):
                if lost := line.lost - self._lost[at]:
                    self._lost[at] = line.lost
                    self._block[Block.INTERRUPTS_LOST] += lost
                    episodes.record_finding(Alarm.INBOX_FULL, self._cycles, tick, lost)

    def preempt_computing(self, tick: int, begin_ns: int, end_ns: int) -> int:
        """Return the end of a computation that the handler preempts. In real time, take the time.

        This is a `rack.boards.run.simulated_time.FinishStep`.

        Args:
            tick: Release tick of the cycle.
            begin_ns: Begin of the cycle.
            end_ns: End of the cycle without its budget and the handler.
        """
        inbox = self._inbox
        if self._clock.is_lockstep:
            time_ns = self._budget_ns + end_ns - begin_ns
            work = Work(begin_ns, time_ns, begin_ns + time_ns + self._longest_ns)
            return inbox.inbox.compute_end(work, self._sources, tick * self._clock_ns)
        begun_ns = process_time_ns()
        taken_ns = 0
        while taken_ns < self._longest_ns:
            inbox.collect_arrivals(self._clock.compute_simulated_ns())
            if self._taken_ns >= inbox.accepted_ns:
                break
            taken_ns += inbox.accepted_ns - self._taken_ns
            self._taken_ns = inbox.accepted_ns
            busy_wait_until(begun_ns + taken_ns)
        return end_ns


def chain_accesses(*accesses: Callable[[int], None] | None) -> Callable[[int], None]:
    """Return a function that makes several accesses one after the other.

    Args:
        accesses: Functions to call with the release tick. None is ignored. A single function is
            returned unchanged.
    """
    present = [access for access in accesses if access is not None]

    def access_all(tick: int) -> None:
        """Make the accesses in their order, each as of `tick`."""
        for access in present:
            access(tick)

    return access_all if len(present) > 1 else present[0]


def slow_access(access: Callable[_P, _R], time_ns: int) -> Callable[_P, _R]:
    """Return a function that calls `access` and takes at least `time_ns` of processor time.

    This emulates a slower bus: programmed transfers over VME occupied the processor. If `time_ns`
    is 0, `access` itself is returned.
    """
    if not time_ns:
        return access

    def access_slowly(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        """Make the access, and busy-wait until it has taken its minimum processor time."""
        end = process_time_ns() + time_ns
        result = access(*args, **kwargs)
        busy_wait_until(end)
        return result

    return access_slowly
