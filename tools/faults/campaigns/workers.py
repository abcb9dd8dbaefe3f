"""Worker processes make the trials, as many at once as there are cores; each trial has its own rack
and leaves a file.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import active_children, get_context
from multiprocessing.queues import SimpleQueue
from pathlib import Path

from rack.backplane.process import die_with_parent
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import WarmCrate
from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.faults.campaigns.base import BaseRack
from rack.tools.faults.campaigns.plan import Plan
from rack.tools.faults.campaigns.results import keep
from rack.tools.faults.campaigns.trial import run_trial

LOOK_S = 0.2
"""Longest time until a campaign that waits for its trials notices an interrupt."""


@dataclass(frozen=True)
class TrialJob:
    """A trial to be made: `ticks` of a faultless run, `seconds` of simulated time where no task
    ends the run.
    """

    plan: Plan
    path: Path
    ticks: int
    seconds: float | None


class Workers:
    """Processes that make trials. Use it as a context; they end with it, and with the process that
    made it.

    `whole`: no trial goes on from a snapshot of the faultless rack.
    """

    def __init__(self, config: RackConfig, whole: bool = False) -> None:
        context = get_context("spawn")
        cores = sorted(os.sched_getaffinity(0))
        numbers = context.SimpleQueue()
        for core in cores:
            numbers.put(core)
        self._most = len(cores)
        self._pool = ProcessPoolExecutor(
            self._most,
            mp_context=context,
            initializer=_begin,
            initargs=(config, whole, numbers, os.getpid()),
        )

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is not None:
            self._stop()
        # Workers without a trial end with the pool, and with them their crates.
        self._pool.shutdown(cancel_futures=True)

    def run(self, jobs: Sequence[TrialJob], alone: bool) -> Iterator[TrialJob]:
        """Make trials and yield each that is done and has its file; a signal ends those in
        progress, which leave none.

        Trials that are `alone` have the machine for themselves. Others get a core each, where their
        boards hand messages to each other sooner.
        """
        waiting = list(jobs)
        busy = dict[Future[str], TrialJob]()
        most = 1 if alone else self._most
        while (waiting or busy) and not INTERRUPT.number:
            while waiting and len(busy) < most:
                job = waiting.pop(0)
                busy[self._pool.submit(_make, job)] = job
            done, _ = wait(busy, LOOK_S, FIRST_COMPLETED)
            for future in done:
                job = busy.pop(future)
                try:
                    wrong = future.result()
                except BrokenProcessPool:
                    wrong = "the process that made it ended"
                if wrong:
                    raise Failure(f"trial {job.plan.number}: {wrong}")
                yield job
        if busy:
            self._stop()

    def _stop(self) -> None:
        """End the workers. What is left of a trial in progress is of no use: its rack is removed,
        not stopped.
        """
        for process in active_children():
            process.terminate()


class TrialMaker:
    """What makes trials in one worker: its core, its crate, and the faultless rack in that."""

    def __init__(self, config: RackConfig, whole: bool, core: int) -> None:
        self._config = config
        self._whole = whole
        self._core = core
        self._cores = os.sched_getaffinity(0)
        self._crate: WarmCrate | None = None
        self._base = BaseRack(config, f"camp-{os.getpid()}x")

    def make(self, job: TrialJob) -> None:
        """Make a trial, and keep its result."""
        is_lockstep = job.plan.lockstep
        os.sched_setaffinity(0, {self._core} if is_lockstep else self._cores)
        crate = self._ready(is_lockstep)
        base = None if self._whole else self._base
        name = self._base.name
        trial = run_trial(
            self._config, job.plan, name, job.ticks, job.seconds, base=base, crate=crate
        )
        keep(trial, job.path)

    def _ready(self, lockstep: bool) -> WarmCrate | None:
        """Return the crate for the next trial; None: the rack starts its own, as in real time,
        where a crate that has served would be another machine.
        """
        if self._crate is not None and (self._crate.is_over or not lockstep):
            self._crate.end()
            self._crate = None
        if lockstep and self._crate is None:
            self._crate = WarmCrate()
        return self._crate


_maker: TrialMaker


def _begin(config: RackConfig, whole: bool, cores: SimpleQueue[int], parent: int) -> None:
    """Begin as a worker: it ends with its parent, and Ctrl-C on the terminal reaches only that."""
    global _maker
    os.setpgid(0, 0)
    INTERRUPT.catch()
    die_with_parent(parent)
    _maker = TrialMaker(config, whole, cores.get())


def _make(job: TrialJob) -> str:
    """Make a trial; return what went wrong, if anything."""
    try:
        _maker.make(job)
    except Exception as error:  # whatever it is, the campaign must hear of it
        return f"{type(error).__name__}: {error}"
    return ""
