"""Worker processes, which run trials in parallel.

There is one for each core. Each trial launches a rack and leaves a file with its result.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import active_children, get_context
from pathlib import Path

from rack.backplane.process import die_with_parent
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import WarmCrate
from rack.boards.crate.rack import build_preload_request
from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.faults.campaigns.base import BaseRack, count_base_ticks
from rack.tools.faults.campaigns.plan import NOMINAL, Plan
from rack.tools.faults.campaigns.results import save_result
from rack.tools.faults.campaigns.trial import Start, run_trial

LOOK_S = 0.2
"""Maximum time until a waiting campaign notices an interrupt."""

WORKER_ENDED = "its worker process has ended"


@dataclass(frozen=True)
class TrialJob:
    """A trial to be run.

    Attributes:
        plan: Plan of the trial.
        path: File for the result.
        ticks: Length of a faultless run in ticks.
        seconds: Simulated time in s after which the run ends if no task ends it.
    """

    plan: Plan
    path: Path
    ticks: int
    seconds: float | None


class Workers:
    """Context manager for processes that run trials.

    They end with the context and with the process that created them. With `whole`, every trial runs
    from tick 0 instead of continuing from a snapshot.
    """

    def __init__(self, config: RackConfig, whole: bool = False) -> None:
        self._late_ticks = count_base_ticks(config)
        context = get_context("spawn")
        # One pool for each process, because not all have the same snapshots. The first process runs
        # the faultless trial.
        self._pools = [
            ProcessPoolExecutor(
                1,
                mp_context=context,
                initializer=_prepare_worker,
                initargs=(config, whole, core, os.getpid()),
            )
            for core in sorted(os.sched_getaffinity(0))
        ]
        self._preparing: list[Future[None]] = []
        for pool in self._pools:
            # Start all processes now, so that they import modules while the campaign is prepared.
            pool.submit(_start_crate)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is not None or INTERRUPT.number:
            # The racks of their trials are removed without being stopped.
            for process in active_children():
                process.terminate()
        # Idle workers, and their crates, end with the pools.
        for pool in self._pools:
            pool.shutdown(cancel_futures=True)

    def run(self, jobs: Sequence[TrialJob], alone: bool) -> Iterator[TrialJob]:
        """Run trials and yield each one when its file is written.

        After an interrupt, the trials in progress leave no file. They end with this context.

        Args:
            jobs: Trials to run.
            alone: Whether each trial gets the whole machine. Otherwise each gets one core, which
                also makes the exchange of messages between its boards faster. The faultless trial
                gets all cores.

        Raises:
            Failure: A trial could not be run.
        """
        waiting = list(jobs)
        busy = dict[Future[str], tuple[TrialJob, ProcessPoolExecutor]]()
        idle = self._pools[:1] if alone else list(self._pools)
        if alone:
            wait(self._preparing)
        elif jobs:
            # Processes without a trial prepare for the next ones.
            self._preparing += [pool.submit(_prepare_base) for pool in idle[len(jobs) :]]
        while (waiting or busy) and not INTERRUPT.number:
            while waiting and idle:
                pool = idle.pop(0)
                # Let the first process run trials that begin late, for which others would first
                # have to run the faultless rack.
                find = max if pool is self._pools[0] else min
                job = find(waiting, key=lambda job: job.plan.first_tick // self._late_ticks)
                waiting.remove(job)
                busy[_submit(pool, job)] = job, pool
            done, _ = wait(busy, LOOK_S, FIRST_COMPLETED)
            for future in done:
                job, pool = busy.pop(future)
                idle.append(pool)
                try:
                    error_text = future.result()
                except BrokenProcessPool:
                    error_text = WORKER_ENDED
                if error_text:
                    raise Failure(f"trial {job.plan.number} failed: {error_text}")
                yield job


def _submit(pool: ProcessPoolExecutor, job: TrialJob) -> Future[str]:
    """Let a worker process run a trial.

    Raises:
        Failure: The process has ended.
    """
    try:
        return pool.submit(_run_job, job)
    except BrokenProcessPool:
        raise Failure(f"trial {job.plan.number} failed: {WORKER_ENDED}") from None


class TrialRunner:
    """Runs the trials of one worker process.

    Its trials in lockstep share a core, a crate and a faultless rack.
    """

    def __init__(self, config: RackConfig, whole: bool, core: int) -> None:
        self._config = config
        self._whole = whole
        self._core = core
        self._cores = os.sched_getaffinity(0)
        self._crate: WarmCrate | None = None
        self._base = BaseRack(config, f"camp-{os.getpid()}x", {core})

    def start_crate(self) -> None:
        """Start the crate before the first trial, so that it imports the levels meanwhile."""
        os.sched_setaffinity(0, {self._core})
        self._prepare_crate(lockstep=True)

    def prepare_base(self) -> None:
        """Take the first snapshot of the faultless rack, before any trial needs one."""
        crate = self._prepare_crate(lockstep=True)
        if crate is not None and not self._whole:
            self._base.run_to_snapshot(crate)

    def run_and_save(self, job: TrialJob) -> None:
        """Run a trial and save its result. In lockstep, use one core only."""
        is_lockstep = job.plan.lockstep
        cores = {self._core} if is_lockstep else set()
        os.sched_setaffinity(0, cores or self._cores)
        crate = self._prepare_crate(is_lockstep)
        base = self._base
        start = Start(whole="as asked")
        if not self._whole:
            if crate is not None and job.plan == NOMINAL:
                # The other workers have nothing to do yet.
                save_result(base.run(crate, job.seconds, self._cores), job.path)
                return
            start = base.find_start(job.plan, crate)
        trial = run_trial(
            self._config,
            job.plan,
            base.name,
            job.ticks,
            job.seconds,
            start=start,
            crate=crate,
            cores=cores,
        )
        save_result(trial, job.path)

    def _prepare_crate(self, lockstep: bool) -> WarmCrate | None:
        """Return the crate for the next trial. None if the rack is to start a new one.

        Each real-time trial gets a fresh crate, because a warm one has different cache and
        page-fault behaviour.
        """
        if self._crate is not None and (self._crate.is_over or not lockstep):
            self._crate.end_crate()
            self._crate = None
        if lockstep and self._crate is None:
            self._crate = WarmCrate()
            self._crate.try_request(build_preload_request(self._config))
        return self._crate


_runner: TrialRunner


def _prepare_worker(config: RackConfig, whole: bool, core: int, parent: int) -> None:
    """Prepare a worker process. It ends with its parent and ignores Ctrl-C on the terminal."""
    global _runner
    os.setpgid(0, 0)
    INTERRUPT.install_handlers()
    die_with_parent(parent)
    _runner = TrialRunner(config, whole, core)


def _start_crate() -> None:
    """Start the crate of a worker process."""
    _runner.start_crate()


def _prepare_base() -> None:
    """Take the first snapshot of the faultless rack of a worker process."""
    _runner.prepare_base()


def _run_job(job: TrialJob) -> str:
    """Run a trial in a worker process. Return the error as text, empty if there is none."""
    try:
        _runner.run_and_save(job)
    except Exception as error:
        # Report any error, because the campaign would otherwise wait for the result.
        return f"{type(error).__name__}: {error}"
    return ""
