"""Semaphores of a rack: in its segment, shared by all processes that attach to it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import pytest

from rack.backplane.address_map import CACHE_LINE
from rack.backplane.clock.lockstep import LockstepDriver
from rack.backplane.clock.wake import NextCycle
from rack.backplane.mailbox.protocols import MailboxLock
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_done_semaphore, get_lock_semaphore, get_wake_semaphore
from rack.backplane.words import Block
from tests.backplane.bus import NAME, mailbox, task
from tests.backplane.conftest import MakeBus
from tests.processes import BOUND_S, FORKS, exit_status, forked, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)
FUTEX_WAIT_BITSET, FUTEX_CLOCK_REALTIME = 9, 256
"""From the kernel's linux/futex.h: the wait of every semaphore, and the flag of one that is by the
wall clock."""


@pytest.fixture
def bus(make_bus: MakeBus) -> Segment:
    return make_bus(
        mailbox("lock"), mailbox(name="writer.other"), task("writer"), task("writer.planner")
    )


def test_semaphores_are_in_separate_cache_lines_and_only_locks_start_posted(bus: Segment) -> None:
    # Tasks have two, and locked mailboxes one.
    places = bus.map
    found = [*places.wake.values(), *places.done.values(), *places.locks.values()]
    assert len(found) == len({address // CACHE_LINE for address in found}) == 5
    assert all(max(places.mailboxes.values()) < at for at in found)
    assert get_lock_semaphore(bus, NAME).value == 1
    assert get_wake_semaphore(bus, "writer").value == 0
    assert get_done_semaphore(bus, "writer").value == 0


def test_processes_that_attach_share_the_semaphores(bus: Segment) -> None:
    get_wake_semaphore(bus, "writer").release()
    with closing(Segment.attach(bus.rack)) as other:
        assert get_wake_semaphore(other, "writer").try_acquire()
    assert not get_wake_semaphore(bus, "writer").try_acquire()


def test_a_wait_lasts_until_its_deadline(bus: Segment) -> None:
    semaphore = get_wake_semaphore(bus, "writer")
    start = time.monotonic()
    assert not semaphore.acquire(0.02)
    assert time.monotonic() - start >= 0.02
    semaphore.release()
    assert semaphore.acquire(0.02)


def test_a_release_ends_a_wait(bus: Segment) -> None:
    semaphore = get_wake_semaphore(bus, "writer")
    parent = os.getpid()

    def release_once_it_waits() -> None:
        # Where the kernel does not show it, what is released comes before the wait at times.
        with suppress(PermissionError):
            wait_until(lambda: futex_call(parent))
        semaphore.release()

    with forked(release_once_it_waits) as releaser:
        assert semaphore.acquire(BOUND_S)
        assert exit_status(releaser) == 0
    assert not semaphore.try_acquire()


def wait_for_tasks(segment: Segment) -> None:
    segment.get_block("writer")[Block.RELEASED] = 0
    LockstepDriver(segment, lambda tick: None, False, 8).run()


WAITS: dict[str, Callable[[Segment], object]] = {
    "release": lambda segment: NextCycle(segment, "writer").wait(),
    "lock": lambda segment: [MailboxLock(segment, NAME, 60).acquire() for _ in range(2)],
    "tasks": wait_for_tasks,
}


def futex_call(pid: int) -> int:
    """Return the operation of the futex call in which a process waits, from /proc; 0: it is in
    none."""
    call = Path(f"/proc/{pid}/syscall").read_text().split()
    operation = int(call[2], 16) if len(call) > 2 else 0
    return operation if operation & ~FUTEX_CLOCK_REALTIME == FUTEX_WAIT_BITSET else 0


@pytest.mark.parametrize("wait", WAITS)
def test_no_step_of_the_wall_clock_moves_the_bound_of_a_wait(bus: Segment, wait: str) -> None:
    # A test cannot set the machine's clock. The kernel shows by which clock a process waits.
    seen = [0]
    with forked(lambda: WAITS[wait](bus)) as pid:
        try:
            wait_until(lambda: seen.append(futex_call(pid)) or seen[-1])
        except PermissionError:
            pytest.skip("this machine does not show in which call a process waits")
    assert not seen[-1] & FUTEX_CLOCK_REALTIME
