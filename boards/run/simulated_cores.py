"""Cores on which cycles take simulated time, in lockstep under `timing.lockstep_load`.

The clock simulates the cores tick by tick. Each cycle computes, states its processor time, and
waits. The clock lets it go on in the tick in which its scheduler lets its job end. Other cycles of
the core, and changes of a scheduler, thus act on jobs that have begun. Plans do the same. Each job
takes two context switches as well, and the clock a job in each tick: as in the timing model.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from rack.backplane.address_map import CLOCK
from rack.backplane.clock.lockstep import LockstepDriver
from rack.backplane.words import Block, Run, Scheduler, System
from rack.boards.timing.scheduler import CoreJob, SimulatedCore
from rack.boards.wiring import Scheduling

if TYPE_CHECKING:
    from rack.boards.run.task import Task

UNKNOWN = 1 << 62
"""Value of `Block.FINISH` until the end of a job is known."""


def await_job_end(task: Task, cost_ns: int, tick: int, begin_ns: int, end_ns: int) -> int:
    """Wait until the job of a cycle ends on the simulated core, and return its end.

    With its task and `cost_ns` given, this is a `rack.boards.run.simulated_time.FinishStep`. It
    must be the last step of the task.

    Args:
        task: The task.
        cost_ns: Processor time of a cycle or plan without the other steps.
        tick: Release of the cycle.
        begin_ns: Begin of the cycle, in simulated time.
        end_ns: Its end after the other steps, whose processor time is added to `cost_ns`.
    """
    task.block[Block.COMPUTING_NS] = cost_ns + end_ns - begin_ns
    task.next_cycle.wait_for_tick(UNKNOWN)
    end_ns = task.block[Block.COMPUTING_NS]
    if task.words[System.STATE] == Run.STOPPED:
        # The job is late if its deadline is not after the run.
        end_ns = (task.words[System.TICK] + 1) * task.simulated.clock_ns
    task.stopwatch.core_ns = max(begin_ns, task.block[Block.BEGUN_NS]), end_ns
    return end_ns


class SimulatedCores:
    """The simulated cores of a rack.

    Args:
        loads: How the tasks, and the clock if it takes time, compete for the cores, by task.
        driver: Driver of the clock.
        clock_ns: Length of a tick in ns.
    """

    def __init__(
        self, loads: Mapping[str, Scheduling], driver: LockstepDriver, clock_ns: int
    ) -> None:
        self._loads = loads
        self._driver = driver
        self._clock_ns = clock_ns
        self._tasks = {task.spec.name: task for task in driver.tasks}
        self._cores = {
            core: SimulatedCore(driver.first_tick * clock_ns)
            for core in sorted({load.core for load in loads.values()})
        }

    def run_tick(self, tick: int) -> None:
        """Let the cycles go on whose jobs end in `tick`. Call this after the releases of `tick`."""
        # A cycle that has missed its deadline may go on at this tick.
        self._driver.resume_cycles(tick)
        begin_ns = tick * self._clock_ns
        for number, core in self._cores.items():
            core.jobs = [j for j in core.jobs if j.task == CLOCK or not self._tasks[j.task].is_lost]
            under_way = {job.task for job in core.jobs}
            for name, load in self._loads.items():
                if load.core == number and name not in under_way:
                    self._add_job(core, name, begin_ns)
            for begun in core.jobs:
                # An operator may have changed it.
                begun.scheduler = self._find_scheduler(begun.task)
            while (job := core.run_until(begin_ns + self._clock_ns)) is not None:
                if job.task == CLOCK:
                    continue
                task = self._tasks[job.task]
                # A job that ends with the tick ends in it.
                task.block[Block.COMPUTING_NS] = min(core.now_ns, begin_ns + self._clock_ns - 1)
                task.block[Block.BEGUN_NS] = job.begun_ns
                self._driver.resume_cycle(task)
                # If the job has missed its deadline, the cycle waits once more.
                self._driver.resume_cycles(tick)
                self._add_job(core, job.task, core.now_ns, after=job)

    def _find_scheduler(self, name: str) -> Scheduler:
        """Return the present scheduler of a task. The clock has the first of those on its core."""
        if name != CLOCK:
            return Scheduler(self._tasks[name].block[Block.SCHEDULER])
        core = self._loads[CLOCK].core
        schedulers = (
            self._find_scheduler(other)
            for other, load in self._loads.items()
            if load.core == core and other != CLOCK
        )
        return max(schedulers, default=Scheduler.FIXED_PRIORITY)

    def _add_job(
        self, core: SimulatedCore, name: str, ready_at: int, after: CoreJob | None = None
    ) -> None:
        """Add the job of the release that a task has taken, if there is one.

        Args:
            core: Core of the task.
            name: Name of the task.
            ready_at: Time in ns from which the job can run.
            after: The late job that the task has just ended. The task has not slept since, so it
                keeps its place in the queue of its priority. None if it was asleep.
        """
        load = self._loads[name]
        clock_ns = self._clock_ns
        if name == CLOCK:
            release, every, cost_ns = ready_at // clock_ns, 1, load.cost_ns
        else:
            task = self._tasks[name]
            block = task.block
            release = block[Block.RELEASED]
            if release > block[Block.DONE]:
                # If a planner makes no plan, there is no job.
                self._driver.await_state(task, task.is_settled)
            if block[Block.FINISH] != UNKNOWN:
                return
            every, cost_ns = task.spec.slice, block[Block.COMPUTING_NS]
        job = CoreJob(
            name,
            self._find_scheduler(name),
            load.priority,
            load.is_critical,
            ready_at,
            deadline_ns=(release + every) * clock_ns,
            left_ns=cost_ns + load.switch_ns,
            locked_ns=load.locked_ns,
            ceiling=load.ceiling,
        )
        if after is not None:
            job.ready_at, job.turn_at, job.turn_ns = after.ready_at, after.turn_at, after.turn_ns
        core.jobs.append(job)
