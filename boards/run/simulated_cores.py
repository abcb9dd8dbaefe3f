"""Cores on which cycles take simulated time, in lockstep under `timing.lockstep_load`.

The clock simulates the cores tick by tick. Each cycle computes, states its processor time, and
waits. The clock lets it go on in the tick in which its scheduler lets its job end. Other cycles of
the core, and changes of a scheduler, thus act on jobs that have begun.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.address_map import CLOCK
from rack.backplane.clock.lockstep import LockstepDriver
from rack.backplane.clock.released_task import ReleasedTask
from rack.backplane.words import Block, Run, Scheduler, System
from rack.boards.timing.scheduler import CoreJob, SimulatedCore
from rack.boards.wiring import ClockWiring, Scheduling

if TYPE_CHECKING:
    from rack.boards.run.task import Task

UNKNOWN = 1 << 62
"""Value of `Block.FINISH` until the end of a job is known."""


class CoreStep:
    """Step of a cycle that waits until its job ends on the simulated core.

    A `rack.boards.run.simulated_time.FinishStep`. It must be the last step of its task.

    Args:
        task: The task.
        cost_ns: Processor time of a cycle without the other steps.
    """

    def __init__(self, task: Task, cost_ns: int) -> None:
        self._task = task
        self._cost_ns = cost_ns

    def __call__(self, tick: int, begin_ns: int, end_ns: int) -> int:
        """Return the end of the job. Its processor time includes that of the other steps."""
        task = self._task
        task.block[Block.COMPUTING_NS] = self._cost_ns + end_ns - begin_ns
        task.next_cycle.wait_for_tick(UNKNOWN)
        is_over = task.words[System.STATE] == Run.STOPPED
        return end_ns if is_over else task.block[Block.COMPUTING_NS]


class SimulatedCores:
    """The simulated cores of a rack.

    Args:
        wiring: Wiring of the clock.
        driver: Driver of the clock.
        clock_ns: Length of a tick in ns.
    """

    def __init__(self, wiring: ClockWiring, driver: LockstepDriver, clock_ns: int) -> None:
        self._wiring = wiring
        self._driver = driver
        self._clock_ns = clock_ns
        self._tasks = {t.spec.name: t for t in driver.tasks if t.spec.name in wiring.schedulings}
        begin_ns = driver.first_tick * clock_ns
        cores = {wiring.simulated_core, *(load.core for load in wiring.schedulings.values())}
        self._cores = {core: SimulatedCore(begin_ns) for core in sorted(cores)}

    def run_tick(self, tick: int) -> None:
        """Let the cycles go on whose jobs end in `tick`. Call this after the releases of `tick`."""
        # A cycle that has missed its deadline may go on at this tick.
        self._driver.resume_cycles(tick)
        for number, core in self._cores.items():
            begin_ns = tick * self._clock_ns
            core.jobs = [
                job for job in core.jobs if job.task != CLOCK and not self._tasks[job.task].is_lost
            ]
            for begun in core.jobs:
                # An operator may have changed it.
                begun.scheduler = Scheduler(self._tasks[begun.task].block[Block.SCHEDULER])
            if number == self._wiring.simulated_core and self._wiring.cost_ns:
                core.jobs.append(self._build_clock_job(tick))
            under_way = {job.task for job in core.jobs}
            for name, load in self._wiring.schedulings.items():
                if load.core == number and name not in under_way:
                    self._add_job(core, self._tasks[name], load, begin_ns)
            while (job := core.run_until(begin_ns + self._clock_ns)) is not None:
                if job.task != CLOCK:
                    task = self._tasks[job.task]
                    task.block[Block.COMPUTING_NS] = core.now_ns
                    self._driver.resume_cycle(task)
                    # If the job has missed its deadline, the cycle waits once more.
                    self._driver.resume_cycles(tick)
                    self._add_job(core, task, self._wiring.schedulings[job.task], core.now_ns)

    def _add_job(
        self, core: SimulatedCore, task: ReleasedTask, load: Scheduling, ready_at: int
    ) -> None:
        """Add the job of the release that a task has taken, if there is one.

        Args:
            core: Core of the task.
            task: The task.
            load: How it competes for the core.
            ready_at: Time in ns from which the job can run.
        """
        block = task.block
        if block[Block.RELEASED] <= block[Block.DONE]:
            return
        self._driver.await_state(task, lambda: task.is_waiting or task.is_lost or task.is_stopped)
        if block[Block.FINISH] != UNKNOWN:
            return
        release = block[Block.RELEASED]
        core.jobs.append(
            CoreJob(
                task.spec.name,
                release,
                Scheduler(block[Block.SCHEDULER]),
                task.spec.priority,
                load.is_critical,
                ready_at,
                deadline_ns=(release + task.spec.every) * self._clock_ns,
                left_ns=block[Block.COMPUTING_NS],
            )
        )

    def _build_clock_job(self, tick: int) -> CoreJob:
        """Return the clock's job of a tick. Its laxity is so small that it precedes all others."""
        scheduler = Scheduler.MAXIMUM_URGENCY_FIRST
        begin_ns = tick * self._clock_ns
        return CoreJob(CLOCK, tick, scheduler, 0, True, begin_ns, -UNKNOWN, self._wiring.cost_ns)
