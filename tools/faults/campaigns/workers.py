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
from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import INTERRUPT
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
    made it."""

    def __init__(self, config: RackConfig) -> None:
        self._config = config
        self._cores = sorted(os.sched_getaffinity(0))
        self._lines: list[Connection] = []
        self._processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *error: object) -> None:
        self._stop()
        for line in self._lines:
            line.close()
        for process in self._processes:
            process.wait()

    def run(self, jobs: Sequence[TrialJob], alone: bool) -> Iterator[TrialJob]:
        """Make trials and yield each that is done and has its file; a signal ends those in
        progress, which leave none.

        Trials that are `alone` have the machine for themselves. Others get one core each: boards
        that share a core hand messages to each other sooner.
        """
        waiting = list(jobs)
        busy = dict[Any, TrialJob]()
        cores = [set(self._cores)] if alone else [{core} for core in self._cores]
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
            here.send(self._config)
            self._lines.append(here)
        return self._lines[:count]


def main() -> None:
    """Make the trials that come over a line, one after the other."""
    INTERRUPT.catch()
    line = Connection(int(sys.argv[1]))
    parent = int(sys.argv[2])
    die_with_parent(parent)
    with suppress(EOFError):
        config = line.recv()
        while True:
            job, cores = line.recv()
            os.sched_setaffinity(0, cores)
            try:
                trial = run_trial(config, job.plan, f"camp-{os.getpid()}x", job.ticks, job.seconds)
                keep(trial, job.path)
            except Exception as error:  # whatever it is, the campaign must hear of it
                line.send(f"{type(error).__name__}: {error}")
            else:
                line.send("")


if __name__ == "__main__":
    main()
