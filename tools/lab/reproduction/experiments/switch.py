"""Measurement of the context switch t_cs of equations 3.8 and 3.9.

An executor wakes up while its planner computes on the same core. The planner reads the clock in a
loop until it sees a gap, and the executor records the times at which it was awake. The gap minus
the executor's time is the time of two switches.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from dataclasses import dataclass
from time import monotonic_ns
from typing import Any

import numpy as np

from rack.backplane.process import die_with_parent, pin_to_core, set_priority
from rack.boards.timing.trace_times import Distribution, compute_distribution
from rack.tools.console.answer import Failure
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


def measure_switch() -> Distribution:
    """Measure the switch on the last core of this machine. This process is the planner.

    Raises:
        Failure: If the executor cannot run at its real-time priority.
    """
    cores = os.sched_getaffinity(0)
    core = max(cores)
    spawn = multiprocessing.get_context("spawn")
    # Two times per wake-up, ns.
    awake = spawn.RawArray("q", 2 * WAKES)
    executor = spawn.Process(target=_run_executor, args=(os.getpid(), core, awake), daemon=True)
    executor.start()
    try:
        deadline = time.monotonic() + READY_TIMEOUT_S
        while not awake[1]:
            if not executor.is_alive() or time.monotonic() > deadline:
                raise Failure("the executor did not start, or SCHED_FIFO is refused")
            time.sleep(PERIOD_S)
        pin_to_core(core)
        set_priority(PLANNER_PRIORITY)
        gaps = _run_planner(awake)
    finally:
        set_priority(0)
        os.sched_setaffinity(0, cores)
        executor.kill()
        executor.join()
    return compute_switch_times_us(gaps, np.reshape(awake, (-1, 2)))


def _run_executor(parent: int, core: int, awake: Any) -> None:
    """Run the executor, which repeatedly sleeps, wakes up and records the time."""
    die_with_parent(parent)
    pin_to_core(core)
    if not set_priority(EXECUTOR_PRIORITY):
        return
    for begin_index in range(0, len(awake), 2):
        time.sleep(PERIOD_S)
        awake[begin_index] = monotonic_ns()
        awake[begin_index + 1] = monotonic_ns()


def _run_planner(awake: Any) -> np.ndarray:
    """For each wake-up of the executor, read the clock in a loop and record the longest gap.

    Returns:
        Start and end of the gaps, ns, shape (n, 2).
    """
    gaps = np.zeros((WAKES, 2), dtype=np.int64)
    for number in range(WAKES):
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
                gaps[number] = last_ns, now_ns
                now_ns = monotonic_ns()
            last_ns = now_ns
        # Leave the core to others until shortly before the next wake-up.
        time.sleep(PERIOD_S - HEAD_START_S)
    return gaps


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
