"""A task as the clock sees it: released, finished, lost and rejoined."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rack.backplane.clock.released_task import ReleasedTask, sort_by_priority
from rack.backplane.words import Block, TaskState
from tests.backplane.bus import layout, task
from tests.backplane.conftest import MakeBus

EVERY, PHASE = 4, 1


@pytest.fixture
def released(make_bus: MakeBus) -> ReleasedTask:
    spec = replace(task("level", every=EVERY), phase=PHASE)
    return ReleasedTask(make_bus(task("first"), spec), spec)


def words(found: ReleasedTask) -> tuple[int, int, int]:
    """Return release, deadline and missed releases."""
    return found.block[Block.RELEASED], found.block[Block.DEADLINE], found.missed


def test_a_release_is_the_newest_of_its_own_grid(released: ReleasedTask) -> None:
    assert released.index == 1
    for tick, release in ((1, 1), (4, 1), (5, 5), (11, 9)):
        released.release(tick)
        assert words(released)[:2] == (release, release + EVERY)
        assert released.deadline == release + EVERY
        released.block[Block.DONE] = release


def test_missed_releases_count_from_the_last_that_was_finished(released: ReleasedTask) -> None:
    block = released.block
    block[Block.DONE] = block[Block.RELEASED]
    missed = []
    for tick in (1, 5, 9, 13):
        released.release(tick)
        missed.append(released.missed)
    assert missed == [0, 1, 2, 3]
    # It finishes each one late.
    for done, tick in ((1, 17), (5, 21), (9, 25)):
        block[Block.DONE] = done
        released.release(tick)
        assert released.missed == 2
    block[Block.DONE] = block[Block.RELEASED]
    released.release(29)
    assert released.missed == 0
    block[Block.DONE] = 28
    released.release(33)
    assert released.missed == 1


def test_a_tick_waits_for_a_task_with_this_deadline(released: ReleasedTask) -> None:
    released.release(5)
    released.block[Block.DONE] = 1
    assert [released.is_finished(tick) for tick in (8, 9)] == [True, False]
    assert not released.is_settled()
    released.is_stopped = True
    assert released.is_settled()
    released.is_stopped = False
    released.block[Block.DONE] = 5
    assert released.is_settled()
    assert released.is_finished(9)


def test_a_lost_task_stays_lost_until_it_has_rejoined(released: ReleasedTask) -> None:
    released.release(5)
    assert released.lost_tick == -1
    released.mark_lost(7)
    block = released.block
    assert (released.lost_tick, block[Block.STATE]) == (7, TaskState.ABSENT)
    assert not released.can_take_release(9)
    assert released.is_settled()
    released.missed = 3
    released.is_stopped = True
    released.admit_new_process()
    assert (released.lost_tick, released.missed, released.is_stopped) == (-1, 0, False)
    assert (block[Block.DONE], block[Block.DEADLINE]) == (5, 0)
    # It is free from its deadline on.
    block[Block.DEADLINE] = 9
    assert [released.can_take_release(tick) for tick in (8, 9)] == [False, True]


@pytest.mark.parametrize("state", TaskState)
def test_the_state_of_a_lost_task_tells_whether_it_is_ready_or_given_up(
    released: ReleasedTask, state: TaskState
) -> None:
    released.block[Block.STATE] = state
    assert released.is_ready == (state.name in ("READY", "RUNNING", "ENDED"))
    assert released.is_given_up == (state.name == "GIVEN_UP")


def test_executors_come_first_then_the_faster_then_the_earlier() -> None:
    planner = replace(task("plan", every=1), role="planner")
    late = replace(task("late", every=2), phase=1)
    slow = task("slow", every=8)
    fast = task("fast", every=2)
    found = sort_by_priority(layout("r", (), [planner, slow, late, fast]))
    assert [spec.name for spec in found] == ["fast", "late", "slow", "plan"]


def test_several_releases_at_once_have_the_deadline_of_the_last(released: ReleasedTask) -> None:
    released.release(6, 2)
    assert words(released)[:2] == (13, 13 + EVERY)
    assert (released.block[Block.FIRST], released.deadline) == (5, 17)
    released.release(17)
    assert (released.block[Block.FIRST], released.block[Block.RELEASED]) == (17, 17)


def test_the_next_event_of_a_task_is_its_deadline_or_its_release(released: ReleasedTask) -> None:
    released.release(5)
    assert released.find_next_event(6) == 9
    # Its plan is due later, or it is not released any more.
    released.deadline = 21
    assert released.find_next_event(6) == 21
    released.deadline = 0
    assert [released.find_next_event(tick) for tick in (4, 5, 8)] == [5, 9, 9]
