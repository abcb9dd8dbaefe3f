"""The semaphores of a rack: made together, open without a name, gone without a trace."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from rack.backplane import semaphores
from rack.backplane.clock.lockstep import LockstepDriver
from rack.backplane.clock.wake import NextCycle
from rack.backplane.errors import SegmentError
from rack.backplane.mailbox.protocols import MailboxLock
from rack.backplane.segment import SHM_FOLDER, Segment
from rack.backplane.words import Block
from tests.backplane.bus import NAME, layout, mailbox, task
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, exit_status, fork, forked, wait_until

FUTEX_WAIT_BITSET, FUTEX_CLOCK_REALTIME = 9, 256
"""From the kernel's linux/futex.h: the wait of every semaphore, and the flag of one that is by the
wall clock."""


@pytest.fixture
def bus(make_bus: MakeBus) -> Segment:
    return make_bus(
        mailbox("lock"), mailbox(name="writer.other"), task("writer"), task("writer.planner")
    )


def named(rack: str) -> int:
    return len(list(SHM_FOLDER.glob(f"sem.*.{rack}.*")))


def test_there_are_two_a_task_and_one_a_locked_mailbox(bus: Segment) -> None:
    names = semaphores.names(bus.layout)
    assert len(names) == len(set(names)) == named(bus.rack) == 5
    assert semaphores.lock_semaphore(bus.rack, NAME).value == 1
    assert semaphores.wake_semaphore(bus.rack, "writer").value == 0
    assert semaphores.done_semaphore(bus.rack, "writer").value == 0


def test_semaphores_of_a_killed_rack_are_replaced_and_work_without_their_names(
    bus: Segment,
) -> None:
    semaphores.wake_semaphore(bus.rack, "writer").release()
    semaphores.create(bus.layout)
    semaphores.open_all(bus.layout)
    assert semaphores.wake_semaphore(bus.rack, "writer").value == 0
    # To remove names twice is no error.
    for _ in range(2):
        semaphores.unlink(bus.layout)
    assert named(bus.rack) == 0
    semaphores.wake_semaphore(bus.rack, "writer").release()
    semaphores.wake_semaphore(bus.rack, "writer").acquire(0)


def test_names_of_a_rack_of_unknown_layout_are_removed_and_no_others(bus: Segment) -> None:
    near = layout(f"{bus.rack}0", (), [task("writer")])
    semaphores.create(near)
    try:
        semaphores.unlink_all(bus.rack)
        assert (named(bus.rack), named(near.rack)) == (0, 2)
    finally:
        semaphores.unlink(near)


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
@pytest.mark.filterwarnings(FORKS)
def test_another_users_semaphore_of_that_name_is_named_and_left_alone(bus: Segment) -> None:
    def create() -> None:
        os.setuid(65_533)
        with pytest.raises(
            SegmentError, match=rf"semaphore /dev/shm/sem.*{bus.rack}.*belongs to another user"
        ):
            semaphores.create(bus.layout)
        semaphores.unlink_all(bus.rack)

    assert exit_status(fork(create)) == 0
    assert named(bus.rack) == 5


def wait_for_release(segment: Segment) -> None:
    NextCycle(segment, "writer").wait()


def wait_for_lock(segment: Segment) -> None:
    MailboxLock(segment, NAME, 60).acquire()
    MailboxLock(segment, NAME, 60).acquire()


def wait_for_tasks(segment: Segment) -> None:
    segment.block("writer")[Block.RELEASED] = 0
    LockstepDriver(segment, lambda tick: None, False, 8).run()


def futex_call(pid: int) -> int:
    """Return the operation of the futex call in which a process waits, from /proc; 0: it is in
    none."""
    call = Path(f"/proc/{pid}/syscall").read_text().split()
    operation = int(call[2], 16) if len(call) > 2 else 0
    return operation if operation & ~FUTEX_CLOCK_REALTIME == FUTEX_WAIT_BITSET else 0


@pytest.mark.filterwarnings(FORKS)
@pytest.mark.parametrize("wait", [wait_for_release, wait_for_lock, wait_for_tasks])
def test_no_step_of_the_wall_clock_moves_the_bound_of_a_wait(
    bus: Segment, wait: Callable[[Segment], None]
) -> None:
    # A test cannot set the machine's clock. The kernel shows by which clock a process waits.
    seen = [0]
    with forked(lambda: wait(bus)) as pid:
        try:
            wait_until(lambda: seen.append(futex_call(pid)) or seen[-1])
        except PermissionError:
            pytest.skip("this machine does not show in which call a process waits")
    assert not seen[-1] & FUTEX_CLOCK_REALTIME
