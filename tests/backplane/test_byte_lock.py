"""The kernel's lock on a byte: exclusive, non-blocking, released with its process."""

from __future__ import annotations

import os
import time

import pytest

from rack.backplane.byte_lock import ByteLock, close_all_files, is_locked, reopen_all
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, descriptors, exit_status, fork, forked, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)
ADDRESS = 400


def test_a_closed_lock_is_free_and_leaves_no_file_open(make_bus: MakeBus) -> None:
    segment = make_bus()
    before = descriptors()
    first = ByteLock(segment.fd, ADDRESS)
    first.take()
    first.close()
    assert descriptors() == before
    second = ByteLock(segment.fd, ADDRESS)
    assert second.take()
    # Its descriptor may be another file's by now.
    first.close()
    assert descriptors() == before + 1


def test_a_lock_ends_with_its_process(make_bus: MakeBus) -> None:
    segment = make_bus()
    mine = ByteLock(segment.fd, ADDRESS)

    def hold() -> None:
        ByteLock(segment.fd, ADDRESS).take()
        segment.words[ADDRESS] = 1
        time.sleep(60)

    with forked(hold):
        wait_until(lambda: segment.words[ADDRESS])
        assert not mine.take()
    assert mine.take()


def test_a_query_concerns_one_byte_and_takes_no_lock(make_bus: MakeBus) -> None:
    segment = make_bus()
    lock = ByteLock(segment.fd, ADDRESS)
    lock.take()
    around = range(ADDRESS - 1, ADDRESS + 2)
    assert [is_locked(segment.fd, address) for address in around] == [False, True, False]
    lock.release()
    assert not is_locked(segment.fd, ADDRESS)
    assert lock.take()


def test_a_fork_closes_its_locks_and_opens_them_on_another_file(make_bus: MakeBus) -> None:
    segment = make_bus()
    lock = ByteLock(segment.fd, ADDRESS)
    other = os.memfd_create("other")

    def switch() -> None:
        before = descriptors()
        close_all_files()
        assert descriptors() < before
        reopen_all(other)
        assert descriptors() == before
        assert lock.take()
        assert [is_locked(fd, ADDRESS) for fd in (segment.fd, other)] == [False, True]

    try:
        assert exit_status(fork(switch)) == 0
    finally:
        os.close(other)
