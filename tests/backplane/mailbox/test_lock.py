"""Protocol lock: bounded waits, mutual exclusion, and holders that die anywhere."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest

from rack.backplane.mailbox.mailbox import Verdict
from rack.backplane.mailbox.protocols import MailboxLock, open_reader, open_writer
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_lock_semaphore
from tests.backplane.bus import NAME, mailbox
from tests.backplane.conftest import MakeBus
from tests.processes import BOUND_S, FORKS, forked, kill, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)
REPORT = 200
"""Words in the free part of the segment's head in which workers report their progress."""
COUNT = 220
WON, LOST = 1, 2


@pytest.fixture
def bus(make_bus: MakeBus) -> Segment:
    return make_bus(mailbox("lock"))


def hold(segment: Segment) -> None:
    assert MailboxLock(segment, NAME, BOUND_S).acquire()
    segment.words[REPORT] = WON
    time.sleep(60)


@contextmanager
def crew(work: Callable[[Segment, int], None], bus: Segment, count: int) -> Iterator[list[int]]:
    """Run so many workers, and kill them at the end; yield the words of their reports."""
    reports = list(range(REPORT + 1, REPORT + 1 + count))
    with ExitStack() as stack:
        for word in reports:
            stack.enter_context(forked(lambda word=word: work(bus, word)))
        yield reports


def test_an_access_that_times_out_is_a_bus_error(bus: Segment) -> None:
    writer, reader = open_writer(bus, NAME), open_reader(bus, NAME)
    with forked(lambda: hold(bus)):
        wait_until(lambda: bus.words[REPORT])
        assert reader.read(0).verdict is Verdict.NONE
    bus.words[REPORT] = 0
    writer.message.id = 1
    assert writer.write(0, now=0)
    assert reader.read(0).is_new
    with forked(lambda: hold(bus)):
        wait_until(lambda: bus.words[REPORT])
        cut_off = reader.read(1)
        assert (cut_off.message.id, cut_off.verdict) == (1, Verdict.BUS_ERROR)
        assert not writer.write(1, now=1)
    assert (reader.statistics.bus_errors, writer.bus_errors, writer.serial) == (2, 1, 1)
    # Its holder lives: the reader was held up by no fault.
    assert (reader.statistics.held_up, reader.statistics.bad_reads) == (0, 2)
    assert writer.write(2, now=2)
    assert reader.read(2).is_new


def test_a_read_delayed_by_a_dead_holder_is_counted_once(bus: Segment) -> None:
    reader = open_reader(bus, NAME)
    with forked(lambda: hold(bus)):
        wait_until(lambda: bus.words[REPORT])
    for _ in range(3):
        reader.read(0)
    assert (reader.statistics.held_up, reader.statistics.bad_reads) == (1, 1)
    assert reader.statistics.bus_errors == 0


def compete(segment: Segment, word: int) -> None:
    """Wait for the holder's end, try once, report the result, and keep the lock if obtained."""
    lock = MailboxLock(segment, NAME)
    segment.words[word] = -1
    while not segment.words[REPORT - 1]:
        pass
    segment.words[word] = WON if lock.acquire() else LOST
    time.sleep(60)


@pytest.mark.slow
@pytest.mark.parametrize("trial", range(6))
def test_of_several_waiters_one_takes_over_from_a_killed_holder(bus: Segment, trial: int) -> None:
    with forked(lambda: hold(bus)) as holder, crew(compete, bus, 3) as reports:
        wait_until(lambda: bus.words[REPORT] and all(bus.words[word] for word in reports))
        kill(holder)
        bus.words[REPORT - 1] = 1
        wait_until(lambda: all(bus.words[word] > 0 for word in reports))
        assert sorted(bus.words[word] for word in reports) == [WON, LOST, LOST]
    lock = MailboxLock(bus, NAME)
    assert any(lock.acquire() for _ in range(3))


def cycle(segment: Segment, word: int = REPORT) -> None:
    """Count in the critical section, by a read and a write that another process in between would
    spoil."""
    lock = MailboxLock(segment, NAME)
    while True:
        if not lock.acquire():
            continue
        before = segment.words[COUNT]
        segment.words[COUNT + 1] = before
        segment.words[COUNT] = segment.words[COUNT + 1] + 1
        lock.release()
        segment.words[word] += 1


def test_only_one_process_is_in_the_critical_section(bus: Segment) -> None:
    with crew(cycle, bus, 3) as reports:
        wait_until(lambda: all(bus.words[word] > 3_000 for word in reports))
        # While this process has the lock nobody counts. On a busy machine a waiter whose time is up
        # may get in first.
        wait_until(MailboxLock(bus, NAME, BOUND_S).acquire)
        counted = bus.words[COUNT]
    # A worker reports its count after the critical section.
    assert 0 <= counted - sum(bus.words[word] for word in reports) <= len(reports)


@pytest.mark.slow
@pytest.mark.parametrize("bystanders", [0, 2])
def test_a_holder_killed_anywhere_does_not_keep_the_lock(bus: Segment, bystanders: int) -> None:
    rng, lock = random.Random(3), MailboxLock(bus, NAME)
    with crew(cycle, bus, bystanders):
        for _ in range(15):
            bus.words[REPORT] = 0
            with forked(lambda: cycle(bus)):
                wait_until(lambda: bus.words[REPORT])
                time.sleep(rng.uniform(0.0, 0.001))
            wait_until(lock.acquire)
            lock.release()


def test_a_holder_overtaken_between_its_two_steps_is_not_the_owner(bus: Segment) -> None:
    slow, quick = MailboxLock(bus, NAME), MailboxLock(bus, NAME)
    # The slow one has passed the semaphore, and is preempted before it owns the lock.
    get_lock_semaphore(bus, NAME).acquire(0)
    assert quick.acquire()
    assert not slow._owner.take()
    # Nor does a semaphore posted once too often let a second one in.
    get_lock_semaphore(bus, NAME).release()
    assert not slow.acquire()
    quick.release()
    assert get_lock_semaphore(bus, NAME).value == 1
    assert slow.acquire()
