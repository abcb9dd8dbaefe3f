"""The standby of the clock waits for the clock's lock, and kills nobody but a stopped clock."""

from __future__ import annotations

import os
import signal
import time

import pytest

from rack.backplane.byte_lock import ProcessLock
from rack.backplane.process import STOPPED_STATES, read_state
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.run.clock_standby import await_clock_lock
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, exit_status, fork, forked, kill, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)
READY, ENDS, CHECKS = 400, 401, 402
"""Words of the segment with which a test waits for its processes."""


def run_clock(segment: Segment) -> None:
    lock = ProcessLock(segment.fd, 8 * System.CLOCK_PID)
    assert lock.take()
    segment.words[READY] = 1
    wait_until(lambda: segment.words[ENDS])


def wait_for_clock(segment: Segment) -> bool:
    """Take the clock's lock, and count the checks before that."""
    sleep = time.sleep

    def count(seconds: float) -> None:
        segment.words[CHECKS] += 1
        sleep(seconds)

    time.sleep = count
    return await_clock_lock(segment, True).take()


def stop(pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)
    wait_until(lambda: read_state(pid) in STOPPED_STATES)


def test_a_stopped_clock_is_killed(make_bus: MakeBus) -> None:
    segment = make_bus()
    with forked(lambda: run_clock(segment)) as clock:
        wait_until(lambda: segment.words[READY])
        segment.words[System.CLOCK_PID] = clock
        stop(clock)
        assert exit_status(fork(lambda: wait_for_clock(segment))) == 0
        assert exit_status(clock) == -signal.SIGKILL


def test_a_foreign_process_with_the_pid_of_the_clock_is_not_killed(make_bus: MakeBus) -> None:
    """As after a clock that has ended, whose number another process has been given."""
    segment = make_bus()
    foreign = fork(lambda: time.sleep(60))
    try:
        stop(foreign)
        segment.words[System.CLOCK_PID] = foreign
        with forked(lambda: run_clock(segment)):
            wait_until(lambda: segment.words[READY])
            standby = fork(lambda: wait_for_clock(segment))
            wait_until(lambda: segment.words[CHECKS] > 1)
            segment.words[ENDS] = 1
            assert exit_status(standby) == 0
        assert read_state(foreign) in STOPPED_STATES
    finally:
        kill(foreign)
