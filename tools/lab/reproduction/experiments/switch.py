"""Measurement of the context switch t_cs of equations 3.8 and 3.9.

An executor wakes up while its planner computes on the same core. The planner reads the clock in a
loop until it sees a gap, and the executor records the times at which it was awake. The gap minus
the executor's time is the time of two switches.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from multiprocessing.synchronize import Barrier, Semaphore
from threading import BrokenBarrierError
from time import monotonic_ns
from typing import Any, NamedTuple

import numpy as np

from rack.backplane.process import die_with_parent, pin_to_core, set_priority
from rack.boards.timing.trace_times import Distribution, compute_distribution
from rack.tools.console.answer import Failure
from rack.tools.lab.benches.harness import stay_on_core
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop

NAME = "nasrem"
PAPER_US = 100.0
"""Task switch on NIST's boards (NISTIR 90-4251, section 4)."""
WAKES = 1000
PERIOD_S = 0.002
HEAD_START_S = 0.0005
# SCHED_FIFO priorities. No task under ordinary scheduling runs between the two.
EXECUTOR_PRIORITY = 80
PLANNER_PRIORITY = 1
MAX_GAP_WAIT_NS = 20_000_000
READY_TIMEOUT_S = 20.0
LAUNCH_S = 3.0


@dataclass(frozen=True)
class SwitchRun:
    """The context switch t_cs of this machine.

    Attributes:
        switch_us: Half the time of both switches around each wake-up that interrupted the planner,
            us.
        assumed_us: Time that the config assumes, us.
    """

    switch_us: Distribution
    assumed_us: float


def _measure_and_compare(workshop: Workshop) -> SwitchRun:
    """Measure the context switch, and return it with the time that the config assumes."""
    return SwitchRun(measure_switch(), 1e3 * workshop.load_config(NAME).timing.context_switch_ms)


SWITCH = Experiment(
    "switch",
    "the context switch",
    WAKES * PERIOD_S + LAUNCH_S,
    SwitchRun,
    _measure_and_compare,
    cores=2,
)


class _Shared(NamedTuple):
    """Data shared by both processes. `gaps` and `awake` contain two times per wake-up, ns."""

    parent: int
    core: int
    wakes: int
    gaps: Any
    awake: Any
    start: Barrier


def measure_switch() -> Distribution:
    """Measure the switch on the last core of this machine, with wake-ups from the first core.

    Raises:
        Failure: If the processes cannot run at real-time priorities.
    """
    cores = sorted(os.sched_getaffinity(0))
    spawn = multiprocessing.get_context("spawn")
    gaps, awake = spawn.RawArray("q", 2 * WAKES), spawn.RawArray("q", 2 * WAKES)
    shared = _Shared(os.getpid(), cores[-1], WAKES, gaps, awake, spawn.Barrier(3))
    wake, work = spawn.Semaphore(0), spawn.Semaphore(0)
    with ExitStack() as stack:
        processes = []
        for loop, semaphore in ((_run_executor, wake), (_run_planner, work)):
            process = spawn.Process(target=_start_loop, args=(loop, semaphore, shared), daemon=True)
            process.start()
            stack.callback(process.join)
            stack.callback(process.kill)
            processes.append(process)
        # Keep this process off the measured core.
        stack.enter_context(stay_on_core(cores[0]))
        try:
            shared.start.wait(READY_TIMEOUT_S)
        except BrokenBarrierError:
            raise Failure(
                "a process of the measurement did not start, or SCHED_FIFO is refused"
            ) from None
        for _ in range(WAKES):
            work.release()
            time.sleep(HEAD_START_S)
            wake.release()
            time.sleep(PERIOD_S - HEAD_START_S)
        for process in processes:
            process.join(READY_TIMEOUT_S)
    return compute_switch_times_us(np.reshape(gaps, (-1, 2)), np.reshape(awake, (-1, 2)))


def _start_loop(
    loop: Callable[[Semaphore, _Shared], None], semaphore: Semaphore, shared: _Shared
) -> None:
    """Pin this process, set its priority, wait for the other one, and run its loop."""
    die_with_parent(shared.parent)
    pin_to_core(shared.core)
    if not set_priority(EXECUTOR_PRIORITY if loop is _run_executor else PLANNER_PRIORITY):
        shared.start.abort()
    shared.start.wait(READY_TIMEOUT_S)
    loop(semaphore, shared)


def _run_executor(semaphore: Semaphore, shared: _Shared) -> None:
    """Run the executor, which repeatedly waits, wakes up and records the time."""
    awake = shared.awake
    for number in range(shared.wakes):
        semaphore.acquire()
        awake[2 * number] = monotonic_ns()
        awake[2 * number + 1] = monotonic_ns()


def _run_planner(semaphore: Semaphore, shared: _Shared) -> None:
    """Run the planner: for each wake-up, read the clock in a loop and record the longest gap."""
    gaps = shared.gaps
    awake = shared.awake
    for number in range(shared.wakes):
        semaphore.acquire()
        begin_ns = last_ns = monotonic_ns()
        longest_ns = 0
        end_index = 2 * number + 1
        awake_ns = 0
        while not awake_ns and last_ns - begin_ns < MAX_GAP_WAIT_NS:
            # Read this before the clock, so that the next value of the clock shows the gap wherever
            # the executor interrupts this loop.
            awake_ns = awake[end_index]
            now_ns = monotonic_ns()
            if now_ns - last_ns > longest_ns:
                longest_ns = now_ns - last_ns
                gaps[2 * number] = last_ns
                gaps[end_index] = now_ns
                now_ns = monotonic_ns()
            last_ns = now_ns


def compute_switch_times_us(gaps: np.ndarray, awake: np.ndarray) -> Distribution:
    """Return the switch times, in us, of the wake-ups that interrupted the planner.

    Args:
        gaps: Start and end of the planner's longest gap at each wake-up, ns, shape (n, 2).
        awake: Start and end of the executor's time awake, ns, shape (n, 2).

    Raises:
        Failure: If no wake-up interrupted the planner.
    """
    is_interrupted = (gaps[:, 0] > 0) & (gaps[:, 0] <= awake[:, 0]) & (awake[:, 1] <= gaps[:, 1])
    both_us = np.diff(gaps - awake, axis=1)[is_interrupted, 0] * 1e-3
    times = compute_distribution(both_us / 2)
    if times is None:
        raise Failure("no wake-up interrupted the planner: the machine is too busy to measure")
    return times
