"""Cores on which cycles take simulated time, in lockstep under `timing.lockstep_load`.

The clock simulates the cores tick by tick. Each cycle computes, states its processor time, and
waits. The clock lets it go on in the tick in which its scheduler lets its job end. Other cycles of
the core, and changes of a scheduler, thus act on jobs that have begun.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from rack.backplane.clock.lockstep import LockstepDriver
from rack.backplane.words import Block, Run, Scheduler, System
from rack.boards.timing.scheduler import CoreJob, SimulatedCore
from rack.boards.wiring import Scheduling

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
        if task.words[System.STATE] == Run.STOPPED:
            # The job is late if its deadline is not after the run.
            return (task.words[System.TICK] + 1) * task.simulated.clock_ns
        return task.block[Block.COMPUTING_NS]


class SimulatedCores:
    """The simulated cores of a rack.

    Args:
        loads: How the executors compete for the cores, by task.
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
        begin_ns = driver.first_tick * clock_ns
        self._cores = {
            core: SimulatedCore(begin_ns) for core in sorted({load.core for load in loads.values()})
        }

    def run_tick(self, tick: int) -> None:
        """Let the cycles go on whose jobs end in `tick`. Call this after the releases of `tick`."""
        # A cycle that has missed its deadline may go on at this tick.
        self._driver.resume_cycles(tick)
        begin_ns = tick * self._clock_ns
        for number, core in self._cores.items():
            core.jobs = [job for job in core.jobs if not self._tasks[job.task].is_lost]
            for begun in core.jobs:
                # An operator may have changed it.
                begun.scheduler = Scheduler(self._tasks[begun.task].block[Block.SCHEDULER])
            under_way = {job.task for job in core.jobs}
            for name, load in self._loads.items():
                if load.core == number and name not in under_way:
                    self._add_job(core, name, begin_ns)
            while (job := core.run_until(begin_ns + self._clock_ns)) is not None:
                task = self._tasks[job.task]
                # A job that ends with the tick ends in it.
                task.block[Block.COMPUTING_NS] = min(core.now_ns, begin_ns + self._clock_ns - 1)
                self._driver.resume_cycle(task)
                # If the job has missed its deadline, the cycle waits once more.
                self._driver.resume_cycles(tick)
                self._add_job(core, job.task, core.now_ns)

    def _add_job(self, core: SimulatedCore, name: str, ready_at: int) -> None:
        """Add the job of the release that a task has taken, if there is one.

        Args:
            core: Core of the task.
            name: Name of the task.
            ready_at: Time in ns from which the job can run.
        """
        task = self._tasks[name]
        block = task.block
        release = block[Block.RELEASED]
        if release > block[Block.DONE]:
            self._driver.await_state(
                task, lambda: task.is_waiting or task.is_lost or task.is_stopped
            )
        if block[Block.FINISH] == UNKNOWN:
            core.jobs.append(
                CoreJob(
                    name,
                    release,
                    Scheduler(block[Block.SCHEDULER]),
                    task.spec.priority,
                    self._loads[name].is_critical,
                    ready_at,
                    deadline_ns=(release + task.spec.every) * self._clock_ns,
                    left_ns=block[Block.COMPUTING_NS],
                )
            )
