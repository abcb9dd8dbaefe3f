"""The machine that tests run on: what it permits, and whose turn it is.

Tests run three at a time. One that judges what real-time processes do on their cores needs the
machine to itself: it is marked `alone`, waits until every other test is done, and no other begins
before it has ended.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import pytest

from rack.backplane.process import DEADLINE, Reservation, set_priority, take_core
from rack.tools.recording.cores import STAT, STEAL_COLUMN
from tests.network_lab import Lab

WAIT_S = 600.0
"""Bound of a wait for one's turn: twice the longest time-out of a test. It does not count in the
test's own time."""
REPEAT_S = 150.0
"""Time in which a run that the machine has disturbed is begun again: half the time-out of a
test."""
_FOLDER = Path(tempfile.gettempdir())


def obtains_deadlines() -> bool:
    """Say whether this machine lets a process reserve processor time on its core."""
    pid = os.fork()
    if not pid:
        is_given = take_core(min(os.sched_getaffinity(0)), 0, Reservation(100_000, 10_000_000))
        os._exit(is_given != DEADLINE)
    return not os.waitpid(pid, 0)[1]


def stolen() -> int:
    """Return how long the hypervisor has held cores back since the machine began, in the kernel's
    steps of 10 ms."""
    return int(STAT.read_text().split(maxsplit=STEAL_COLUMN + 1)[STEAL_COLUMN])


Run = TypeVar("Run")


def run_undisturbed(
    run: Callable[[], Run], find_disturbance: Callable[[Run], str], times: int = 10
) -> Run:
    """Return the first run in real time that the machine has not disturbed; the test fails when all
    were.

    Only for what a machine that does other work cannot show. The judgement on a run rests on what
    it recorded about its clock, never on what the test asserts about it.

    Args:
        run: Runs once.
        find_disturbance: Says what disturbed a run; "" for nothing.
        times: Most runs. None begins later than `REPEAT_S` after the first.
    """
    found: list[str] = []
    end_s = time.monotonic() + REPEAT_S
    while len(found) < times and time.monotonic() < end_s:
        result = run()
        if not (why := find_disturbance(result)):
            return result
        found.append(why)
    return pytest.fail(f"the machine disturbed each of {len(found)} runs: {'; '.join(found)}")


needs_fifo = pytest.mark.skipif(
    not (set_priority(1) and set_priority(0)), reason="needs real-time priorities"
)
needs_deadlines = pytest.mark.skipif(
    not obtains_deadlines(), reason="needs SCHED_DEADLINE on one core"
)
needs_two_cores = pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
needs_lab = pytest.mark.skipif(bool(Lab.is_possible()), reason=Lab.is_possible())


@contextmanager
def turn(alone: bool) -> Iterator[None]:
    """Have one's turn on the machine, alone or beside others. Raises `TimeoutError` when it does
    not come."""
    # Who waits to be alone keeps the gate: nobody new comes in before it.
    with (
        _locked("gate", fcntl.LOCK_EX) as gate,
        _locked("machine", fcntl.LOCK_EX if alone else fcntl.LOCK_SH),
    ):
        fcntl.flock(gate, fcntl.LOCK_UN)
        yield


@contextmanager
def _locked(name: str, how: int) -> Iterator[int]:
    fd = os.open(_FOLDER / f"rack-tests-{os.getuid()}-{name}", os.O_CREAT | os.O_RDWR, 0o600)
    try:
        deadline = time.monotonic() + WAIT_S
        while not _obtained(fd, how):
            if time.monotonic() > deadline:
                raise TimeoutError(f"no turn on the machine within {WAIT_S:g} s")
            # A lock with a bound: the kernel's own wait has none.
            time.sleep(0.02)
        yield fd
    finally:
        # Not by closing alone: a process that a test has forked holds it open.
        fcntl.flock(fd, fcntl.LOCK_UN)
        os.close(fd)


def _obtained(fd: int, how: int) -> bool:
    try:
        fcntl.flock(fd, how | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
