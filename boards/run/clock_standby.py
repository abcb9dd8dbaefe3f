"""The standby of the clock: a process that runs the clock once the clock's process has ended.

The process that runs the clock holds the kernel's lock on `System.CLOCK_PID` for as long as it
lives. Whichever process gets the lock runs the clock, so there is never more than one. The new
clock continues on the existing grid, as after a restart, but without the time of a restart. A clock
that a signal has stopped is killed, because its lock must become free.
"""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress

from rack.backplane.byte_lock import ProcessLock, holds_lock
from rack.backplane.process import STOPPED_STATES, read_state
from rack.backplane.segment import Segment
from rack.backplane.words import Run, System

POLL_S = 0.001
"""Time between two checks of the clock in lockstep, and before its first tick."""


def await_clock_lock(segment: Segment, is_standby: bool) -> ProcessLock:
    """Wait until no other process runs the clock, and take its lock.

    Args:
        segment: Memory of the rack.
        is_standby: True to wait until another process has run the clock.

    Returns:
        The lock, which the caller must keep.
    """
    words = segment.words
    lock = ProcessLock(segment.fd, 8 * System.CLOCK_PID)
    while is_standby and not words[System.CLOCK_PID] and words[System.STATE] != Run.STOPPED:
        time.sleep(POLL_S)
    while not lock.take():
        _kill_stopped_clock(segment)
        time.sleep(_compute_wait_s(words))
    return lock


def _kill_stopped_clock(segment: Segment) -> None:
    """Kill the clock's process if a signal has stopped it. Only that process has the lock."""
    pid = segment.words[System.CLOCK_PID]
    if pid <= 0 or read_state(pid) not in STOPPED_STATES:
        return
    # The descriptor belongs to one process, whose number may be given to another one later.
    with suppress(ProcessLookupError):
        pidfd = os.pidfd_open(pid)
        try:
            is_clock = holds_lock(pid, segment.fd, 8 * System.CLOCK_PID)
            if is_clock and read_state(pid) in STOPPED_STATES:
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
        finally:
            os.close(pidfd)


def _compute_wait_s(words: memoryview) -> float:
    """Return the time until the next check, in s: in real time the next grid point of a tick."""
    epoch_ns = words[System.EPOCH_NS]
    if words[System.LOCKSTEP] or words[System.STATE] != Run.RUNNING or not epoch_ns:
        return POLL_S
    period_ns = words[System.PERIOD_NS]
    since_ns = time.monotonic_ns() - epoch_ns
    return (period_ns - since_ns % period_ns) * 1e-9
