"""Worker processes make the trials, as many at once as there are cores; each trial has its own rack
and leaves a file.

As a program, `python -m rack.tools.faults.campaigns.workers FD PARENT`: one such process; it ends
with its parent.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import Any

from rack.backplane.process import die_with_parent
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import WarmCrate
from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.faults.campaigns.base import BaseRun
from rack.tools.faults.campaigns.plan import Plan
from rack.tools.faults.campaigns.results import keep
from rack.tools.faults.campaigns.trial import run_trial

LOOK_S = 0.2
"""Longest time until a campaign that waits for its trials notices an interrupt."""


@dataclass(frozen=True)
class TrialJob:
    """A trial to be made: `ticks` of a faultless run, `seconds` of simulated time where no task
    ends the run."""

    plan: Plan
    path: Path
    ticks: int
    seconds: float | None


class Workers:
    """Processes that make trials. Use it as a context; they end with it, and with the process that
    made it.

    `base`: the folder of the run from which trials go on.
    """

    def __init__(self, config: RackConfig, base: Path | None = None) -> None:
        self._order = config, base
        self._cores = sorted(os.sched_getaffinity(0))
        self._lines: list[Connection] = []
        self._processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is not None:
            self._stop()
        # Workers without a trial end with their lines, and with them their crates.
        for line in self._lines:
            line.close()
        for process in self._processes:
            process.wait()

    def run(self, jobs: Sequence[TrialJob], alone: bool) -> Iterator[TrialJob]:
        """Make trials and yield each that is done and has its file; a signal ends those in
        progress, which leave none.

        Trials that are `alone` have the machine for themselves. Others share its cores: many get
        one each, where their boards hand messages to each other sooner; a single one gets all.
        """
        waiting = list(jobs)
        busy = dict[Any, TrialJob]()
        shares = 1 if alone else min(len(self._cores), max(1, len(waiting)))
        cores = [set(self._cores[first::shares]) for first in range(shares)]
        while (waiting or busy) and not INTERRUPT.number:
            lines = self._some(min(len(cores), len(waiting) + len(busy)))
            for line, its_cores in zip(lines, cores, strict=False):
                if line not in busy and waiting:
                    busy[line] = waiting.pop(0)
                    line.send((busy[line], its_cores))
            ready: list[Any] = wait(list(busy), LOOK_S)
            for line in ready:
                yield self._done(line, busy.pop(line))
        if busy:
            self._stop()

    def _done(self, line: Any, job: TrialJob) -> TrialJob:
        try:
            wrong = line.recv()
        except (EOFError, ConnectionResetError):
            wrong = "the process that made it ended"
        if wrong:
            raise Failure(f"trial {job.plan.number}: {wrong}")
        return job

    def _stop(self) -> None:
        """End the workers. What is left of a trial in progress is of no use: its rack is removed,
        not stopped."""
        for process in self._processes:
            process.terminate()

    def _some(self, count: int) -> list[Connection]:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        while len(self._lines) < count:
            here, there = Pipe()
            command = [
                sys.executable,
                "-P",
                "-m",
                "rack.tools.faults.campaigns.workers",
                str(there.fileno()),
                str(os.getpid()),
            ]
            # In a process group of its own: Ctrl-C on the terminal reaches only the campaign, which
            # stops its workers.
            process = subprocess.Popen(
                command, env=environment, pass_fds=[there.fileno()], process_group=0
            )
            self._processes.append(process)
            there.close()
            here.send(self._order)
            self._lines.append(here)
        return self._lines[:count]


class Crates:
    """Keeps a crate for trials in lockstep. In real time each has its own: there a crate that has
    served would be another machine."""

    def __init__(self) -> None:
        self._crate: WarmCrate | None = None

    def __enter__(self) -> Crates:
        return self

    def __exit__(self, *error: object) -> None:
        if self._crate is not None:
            self._crate.end()

    def ready(self, lockstep: bool) -> WarmCrate | None:
        """Return the crate for the next trial; None: the rack starts its own."""
        if self._crate is not None and (self._crate.is_over or not lockstep):
            self._crate.end()
            self._crate = None
        if lockstep and self._crate is None:
            self._crate = WarmCrate()
        return self._crate


def main() -> None:
    """Make the trials that come over a line, one after the other."""
    INTERRUPT.catch()
    line = Connection(int(sys.argv[1]))
    parent = int(sys.argv[2])
    die_with_parent(parent)
    with suppress(EOFError), Crates() as crates:
        config, folder = line.recv()
        base = None if folder is None else BaseRun(config, folder)
        while True:
            job, cores = line.recv()
            os.sched_setaffinity(0, cores)
            crate = crates.ready(job.plan.lockstep)
            try:
                name = f"camp-{os.getpid()}x"
                trial = run_trial(
                    config, job.plan, name, job.ticks, job.seconds, base=base, crate=crate
                )
                if base is not None and job.plan.purpose == "nominal":
                    base.keep(trial.events)
                keep(trial, job.path)
            except Exception as error:  # whatever it is, the campaign must hear of it
                line.send(f"{type(error).__name__}: {error}")
            else:
                line.send("")


if __name__ == "__main__":
    main()
