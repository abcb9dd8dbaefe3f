"""The cycles of a level: `procedure level()` of the paper (section 2).

`VirtualControlLoop` is its executor section and `PlannerLoop` its planner. The paper's `cobegin`
becomes two processes: on one core with different priorities (tightly coupled), or on two cores
(loosely coupled). `lock` and `unlock` are inside the mailboxes, because only protocol `lock` needs
them. The stopwatch takes time stamps, writes the trace and counts. Faults begin and end between
cycles.
"""

from __future__ import annotations

from time import monotonic_ns

from rack.backplane.process import set_priority
from rack.backplane.segment import Segment
from rack.backplane.trace import Flag
from rack.backplane.watch.alarms import CLEAN_READS, Alarm
from rack.backplane.words import Block, Demand, System
from rack.boards.exchange import EXCHANGE_PORT, ExchangeRecord
from rack.boards.run.task import ClockGuard, Task, chain_accesses, slow_access
from rack.boards.wiring import TaskWiring
from rack.levels.level import Executor, Planner
from rack.levels.messages import ArmState

_DEMANDS = tuple(Demand)


class VirtualControlLoop(Task):
    """The executor section of `procedure level()`, which has the higher priority.

        repeat
          waituntil(next-cycle); update(next-cycle)
          lock; read_command; unlock; lock; read_status; unlock
          read plan
          process
          lock; write_command; unlock; lock; write_status; unlock
        until forever

    At the beginning of a cycle, the exchange (C of fig. 4) transfers the plan over the bus from the
    planner's processor, so that the plan is available locally.
    """

    def __init__(
        self, segment: Segment, wiring: TaskWiring, executor: Executor, attention: int | None
    ) -> None:
        super().__init__(segment, wiring, executor, attention)
        self.executor = executor
        self._arm_state = next(
            (
                writer.message
                for writer in self.outputs.writers.values()
                if isinstance(writer.message, ArmState)
            ),
            None,
        )
        self._guard = ClockGuard(segment, self.alarms, self.block) if wiring.guards_clock else None
        self._has_cycled = False
        self._raised: dict[int, int] = {}  # tick of the last user-defined finding, by its number
        self._due = segment.layout.compute_due_ticks(self.spec)
        times = wiring.transfer
        self.exchange = slow_access(self.inputs.exchange_plan, times.exchange_ns)
        record = None
        if wiring.exchange:
            message = self.outputs.writers[EXCHANGE_PORT].message
            record = ExchangeRecord(self.inputs.mailboxes, message).fill_message
        reads = chain_accesses(self.inputs.read_command_and_status, record)
        settings = executor.take_settings if executor.is_set_by_board else None
        self.read_command_and_status = chain_accesses(
            self.serve, slow_access(reads, times.read_ns), settings
        )
        self.write_command_and_status = slow_access(self.outputs.write, times.write_ns)

    def cycle(self, tick: int) -> None:
        """Run the cycle released at `tick`."""
        watch = self.stopwatch
        deadline = tick + self._due
        watch.start_cycle(tick, self.next_cycle.skipped)
        if watch.is_late:
            self._handle_late_start(tick)
        guard = self._guard
        if guard is not None and self.words[System.CLOCK_SKIPPED] != guard.reported:
            guard.report_skipped(tick)
        if self.inputs.reads_plan:
            self.exchange(tick)
            watch.plan_ns = monotonic_ns()
        self.read_command_and_status(tick)
        watch.read_ns = monotonic_ns()
        self.process(tick)
        ended = self.end_computing(tick, deadline) if self.simulated.steps else None
        watch.process_ns = monotonic_ns()
        in_time = self.write_command_and_status(tick, ended or watch.find_late_tick(deadline))
        watch.end_ns = monotonic_ns()
        in_time = in_time and (ended is None or ended < deadline)
        watch.finish_cycle(in_time, deadline, done=tick)

    def _handle_late_start(self, tick: int) -> None:
        """Handle the late start of a cycle: check whether the clock was late.

        Tell the level if it has missed a deadline. If releases were skipped before the cycle, or if
        it is the first, also record this tick as the beginning of regular reads.
        """
        skipped = self.next_cycle.skipped
        if self._has_cycled and (skipped or self.stopwatch.has_missed):
            self.executor.handle_missed_deadline(tick, skipped)
        if skipped or not self._has_cycled:
            self.inputs.task.since = tick
            self._has_cycled = True
        if self._guard is not None:
            self._guard.check_release(tick, self.stopwatch.late_ns)

    def process(self, tick: int) -> None:
        """Run the level's `process`, then handle its findings and the faults that are active."""
        executor = self.executor
        executor.demand = _DEMANDS[self.words[System.DEMAND]]
        executor.process(tick)
        for complete_cycle in executor.complete_cycle:
            complete_cycle(self._arm_state)
        if executor.findings or executor.acted or self.faults.loads:
            self._report_findings(tick)

    def _report_findings(self, tick: int) -> None:
        """Raise alarms for the level's findings, and record which faults of the arm acted.

        Also burn the processor time of load faults.
        """
        executor = self.executor
        for finding in executor.findings:
            # A level may raise user-defined findings in every cycle. Raise one alarm per episode.
            if finding.alarm is not Alarm.OWN or self._record_own_finding(finding.subject, tick):
                self.alarms.raise_alarm(tick, *finding)
        executor.findings.clear()
        self.faults.count_actions(executor.acted, tick)
        executor.acted.clear()
        self.faults.burn_time(tick)

    def _record_own_finding(self, number: int, tick: int) -> bool:
        """Record a user-defined finding, and return whether it begins an episode.

        Args:
            number: Number of the kind of finding among those that the level declares.
            tick: Release tick of the cycle.

        Returns:
            True if the finding begins an episode, because the last one of this kind is more than
                `CLEAN_READS` cycles ago.
        """
        last = self._raised.get(number)
        self._raised[number] = tick
        return last is None or tick - last > CLEAN_READS * self.spec.every


class PlannerLoop(Task):
    """The planner of `procedure level()`, which plans in the background within a time slice.

        repeat
          plan
          lock; write_plan; unlock
        until forever

    In every cycle it asks the level whether a plan is wanted. If planner and executor are tightly
    coupled and the plan has protocol `lock`, writing the plan is the paper's critical section,
    which the executor cannot preempt.
    """

    def __init__(
        self, segment: Segment, wiring: TaskWiring, planner: Planner, attention: int | None
    ) -> None:
        super().__init__(segment, wiring, planner, attention)
        self.planner = planner
        self.slice = self.spec.slice
        self.read = chain_accesses(self.serve, self.inputs.read)
        self.write_plan = slow_access(self.outputs.write, wiring.transfer.update_ns)
        self._critical_priority = wiring.critical_priority
        self._priority = self.block[Block.PRIORITY]

    def cycle(self, tick: int) -> None:
        """Run the cycle released at `tick`, and make a plan if one is wanted."""
        watch = self.stopwatch
        watch.start_cycle(tick, self.next_cycle.skipped)
        self.read(tick)
        watch.read_ns = monotonic_ns()
        if not self.planner.wanted(tick):
            self._pass_release(tick)
            return
        # Reserve the time slice of a plan. Until its end the clock does not release this task.
        deadline = tick + self.slice
        self.next_cycle.skip_until(deadline)
        self.block[Block.DEADLINE] = deadline
        watch.notify_clock()
        self.planner.plan(tick)
        self.faults.burn_time(tick)
        ended = self.end_computing(tick, deadline) if self.simulated.steps else None
        if self._critical_priority:
            # At this priority the executor cannot preempt the update of the plan.
            set_priority(self._critical_priority)
        try:
            # Take the time stamps at this priority. Otherwise the executor could run between a
            # stamp and the write.
            watch.process_ns = monotonic_ns()
            in_time = self.write_plan(tick, ended or watch.find_late_tick(deadline))
            watch.end_ns = monotonic_ns()
        finally:
            if self._critical_priority:
                set_priority(self._priority)
        self.block[Block.PLANS] += 1
        # A plan that began late may still use its whole slice. All releases within the slice count
        # as done.
        done = max(tick, min(self.block[Block.RELEASED], deadline - self.spec.every))
        in_time = in_time and (ended is None or ended < deadline)
        watch.finish_cycle(in_time, deadline, done, Flag.PLANNED)

    def _pass_release(self, tick: int) -> None:
        """Finish a cycle in which no plan is wanted, and publish messages that faults have delayed.

        The cycle is traced only if it was late or releases were skipped before it.
        """
        self.outputs.flush_delayed(tick, self.clock.compute_tick())
        in_time = self.clock.compute_tick() < tick + self.slice
        if in_time and not self.next_cycle.skipped:
            self.stopwatch.finish_idle_cycle()
            return
        self.stopwatch.process_ns = self.stopwatch.end_ns = monotonic_ns()
        self.stopwatch.finish_cycle(in_time, tick + self.slice, tick)
