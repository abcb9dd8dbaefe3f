"""The context switch t_cs of eqs 3.8 and 3.9: an executor wakes up while its planner computes on
the same core.

The planner reads the clock in a loop until it sees a gap; the executor notes when it was awake. The
gap without the executor's time is the two switches.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import ceil
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Barrier
from threading import BrokenBarrierError
from time import monotonic_ns
from typing import Any, NamedTuple

import numpy as np
import posix_ipc

from rack.backplane.process import die_with_parent, pin, set_priority
from rack.levels.timing.trace_times import Distribution, distribution
from rack.tools.console.answer import Failure
from rack.tools.lab.benches.harness import BenchResult, pinned

PAPER_US = 100.0
"""Task switch on NIST's boards (NISTIR 90-4251, section 4)."""
WAKES = 1000
PERIOD_S = 0.002
HEAD_START_S = 0.0005
EXECUTOR = 80
PLANNER = 1
"""SCHED_FIFO priorities: no task under ordinary scheduling runs between the two."""
PATIENCE_NS = 20_000_000
READY_S = 20.0


@dataclass(frozen=True)
class SwitchCost(BenchResult):
    """Times in us over `wakes` wake-ups on `core`.

    `in_us` is from planner to executor, `out_us` back; `switch_us`, t_cs, is half of both together.
    """

    name = "switch"

    core: int
    wakes: int
    in_us: Distribution
    out_us: Distribution
    switch_us: Distribution
    paper_us: float = PAPER_US

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield the figures as text for people."""
        yield (
            f"context switch on core {self.core}, us; an executor preempted its planner"
            f" {self.wakes} times"
        )
        rows = {
            "planner to executor": self.in_us,
            "executor to planner": self.out_us,
            "t_cs": self.switch_us,
        }
        for name, found in rows.items():
            yield (
                f"  {name:20} p50 {found['p50']:6.1f}   p99 {found['p99']:6.1f}   max"
                f" {found['max']:8.1f}"
            )
        yield f"  the paper's boards   {self.paper_us:g}"
        yield f"for a config: timing.context_switch_ms = {ceil(self.switch_us['p99']) * 1e-3:.3f}"


def measure() -> SwitchCost:
    """Measure on the last core of this machine, woken from another. Raises `Failure` if the machine
    has one core."""
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        raise Failure("measuring a context switch needs two cores: this machine has one")
    return cost_of(cores[-1], *_run(cores[-1], cores[0]))


class _Shared(NamedTuple):
    """Shared by both processes. `gaps` and `awake` hold two times per wake-up, ns; `ready` 1 or -1
    for each process."""

    parent: int
    core: int
    gaps: Any
    awake: Any
    ready: Any
    start: Barrier


def _run(core: int, other: int) -> tuple[np.ndarray, np.ndarray]:
    """Run both processes; return the planner's gaps and the executor's times awake, shape (n, 2),
    ns."""
    spawn = multiprocessing.get_context("spawn")
    gaps, awake, ready = (spawn.RawArray("q", size) for size in (2 * WAKES, 2 * WAKES, 2))
    shared = _Shared(os.getpid(), core, gaps, awake, ready, spawn.Barrier(3))
    with _semaphore() as wake, _semaphore() as work:
        executor = spawn.Process(target=_execute, args=(wake.name, shared), daemon=True)
        planner = spawn.Process(target=_plan, args=(work.name, shared), daemon=True)
        # This process is kept off the measured core.
        with _alive(executor, planner), pinned(other):
            _await(shared)
            for _ in range(WAKES):
                work.release()
                time.sleep(HEAD_START_S)
                wake.release()
                time.sleep(PERIOD_S - HEAD_START_S)
            executor.join(READY_S)
            planner.join(READY_S)
    return np.array(gaps).reshape(-1, 2), np.array(awake).reshape(-1, 2)


def _execute(wake: str, shared: _Shared) -> None:
    """Wake up and wait again: an executor with nothing to do."""
    semaphore = _begin(wake, shared, 0, EXECUTOR)
    awake = shared.awake
    for at in range(WAKES):
        semaphore.acquire()
        awake[2 * at] = monotonic_ns()
        awake[2 * at + 1] = monotonic_ns()


def _plan(work: str, shared: _Shared) -> None:
    """Compute when there is work, until the executor has interrupted; keep the longest gap."""
    semaphore = _begin(work, shared, 1, PLANNER)
    gaps = shared.gaps
    awake = shared.awake
    for at in range(WAKES):
        semaphore.acquire()
        begin = last = monotonic_ns()
        longest = 0
        over = 2 * at + 1
        seen = 0
        while not seen and last - begin < PATIENCE_NS:
            # Read before the clock: wherever in this loop the executor interrupts, the next clock
            # value shows it.
            seen = awake[over]
            now = monotonic_ns()
            if now - last > longest:
                longest = now - last
                gaps[2 * at] = last
                gaps[over] = now
                now = monotonic_ns()
            last = now


def _begin(semaphore: str, shared: _Shared, number: int, priority: int) -> posix_ipc.Semaphore:
    """Pin this process, set its priority, and wait for the other one; return its semaphore."""
    die_with_parent(shared.parent)
    pin(shared.core)
    found = posix_ipc.Semaphore(semaphore)
    shared.ready[number] = 1 if set_priority(priority) else -1
    shared.start.wait(READY_S)
    return found


@contextmanager
def _semaphore() -> Iterator[posix_ipc.Semaphore]:
    semaphore = posix_ipc.Semaphore(None, posix_ipc.O_CREX)
    try:
        yield semaphore
    finally:
        semaphore.unlink()


@contextmanager
def _alive(*processes: BaseProcess) -> Iterator[None]:
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.join()


def _await(shared: _Shared) -> None:
    """Wait until both run: importing takes a moment."""
    try:
        shared.start.wait(READY_S)
    except BrokenBarrierError:
        raise Failure("a process of the measurement did not start") from None
    if min(shared.ready) < 0:
        raise Failure("SCHED_FIFO is refused: an executor cannot preempt its planner")


def cost_of(core: int, gaps: np.ndarray, awake: np.ndarray) -> SwitchCost:
    """Return the cost over the wake-ups that interrupted the planner. Raises `Failure` if none
    did."""
    found = (gaps[:, 0] > 0) & (gaps[:, 0] <= awake[:, 0]) & (awake[:, 1] <= gaps[:, 1])
    if not found.any():
        raise Failure("no wake-up interrupted the planner: the machine is too busy to measure")
    into = (awake - gaps)[found, 0] * 1e-3
    back = (gaps - awake)[found, 1] * 1e-3
    in_us, out_us, switch_us = (
        distribution(times) or {} for times in (into, back, (into + back) / 2)
    )
    return SwitchCost(core, int(found.sum()), in_us, out_us, switch_us)
