"""The semaphores of a rack: made together, open without a name, gone without a trace."""

from __future__ import annotations

import pytest

from backplane import semaphores
from backplane.segment import SHM_FOLDER, Segment
from tests.backplane.bus import NAME, layout, mailbox, task
from tests.backplane.conftest import MakeBus


@pytest.fixture
def bus(make_bus: MakeBus) -> Segment:
    return make_bus(mailbox("lock"), mailbox(name="writer.other"), task("writer"), task("writer.planner"))


def named(rack: str) -> int:
    return len(list(SHM_FOLDER.glob(f"sem.*.{rack}.*")))


def test_there_is_one_a_task_one_a_locked_mailbox_and_the_clocks(bus: Segment) -> None:
    assert len(semaphores.names(bus.layout)) == len(set(semaphores.names(bus.layout))) == named(bus.rack) == 4


def test_locks_begin_free_and_wake_ups_unsent(bus: Segment) -> None:
    assert semaphores.lock_semaphore(bus.rack, NAME).value == 1
    assert semaphores.wake_semaphore(bus.rack, "writer").value == 0
    assert semaphores.clock_semaphore(bus.rack).value == 0


def test_what_a_killed_rack_left_is_replaced(bus: Segment) -> None:
    semaphores.wake_semaphore(bus.rack, "writer").release()
    semaphores.create(bus.layout)
    semaphores.open_all(bus.layout)
    assert semaphores.wake_semaphore(bus.rack, "writer").value == 0


def test_open_semaphores_work_without_their_names(bus: Segment) -> None:
    semaphores.open_all(bus.layout)
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


def test_removing_names_twice_is_no_error(bus: Segment) -> None:
    semaphores.unlink(bus.layout)
    semaphores.unlink(bus.layout)
    semaphores.unlink_all(bus.rack)
    assert named(bus.rack) == 0
