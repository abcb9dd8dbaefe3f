"""Waiting for the next cycle: on the grid, skipping passed releases, and within a bound."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace
from typing import get_args

import pytest

from rack.backplane.clock.driver import RealtimeDriver
from rack.backplane.clock.wake import NextCycle
from rack.backplane.layout import Wake
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_wake_semaphore
from rack.backplane.watch.alarms import Alarm, AlarmWriter, open_alarm_ring
from rack.backplane.words import Block, Run, System
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, forked, in_thread, wait_until

WAKES = pytest.mark.parametrize("wake", get_args(Wake), indirect=True)
EVERY = 4
PERIOD_NS = 2_500_000
HOUR_NS = 3_600_000_000_000
"""A tick that no machine is late by."""


@pytest.fixture
def wake(request: pytest.FixtureRequest) -> Wake:
    """How the task waits: by signal, unless the test is parametrized otherwise."""
    return getattr(request, "param", "signal")


@pytest.fixture
def bus(make_bus: MakeBus, wake: Wake) -> Segment:
    return make_bus(task("level", every=EVERY, wake=wake))


def start_grid(segment: Segment, passed_ns: int = 0, period_ns: int = PERIOD_NS) -> None:
    """Start a grid with tick 0 that long ago."""
    segment.words[System.PERIOD_NS] = period_ns
    segment.words[System.EPOCH_NS] = time.monotonic_ns() - passed_ns


def release(segment: Segment, tick: int) -> None:
    segment.get_block("level")[Block.RELEASED] = tick
    get_wake_semaphore(segment, "level").release()


def test_a_task_with_a_phase_waits_for_its_own_ticks(make_bus: MakeBus) -> None:
    bus = make_bus(replace(task("level", every=EVERY), phase=3))
    cycle, seen = NextCycle(bus, "level"), []
    for tick in (3, 7, 19):
        release(bus, tick)
        seen.append((cycle.wait(), cycle.skipped))
    assert seen == [(3, 0), (7, 0), (19, 2)]
    # A new process takes the next release on the same grid, and a plan ends on it.
    bus.get_block("level")[Block.DONE] = 19
    cycle = NextCycle(bus, "level")
    release(bus, 23)
    assert (cycle.wait(), cycle.skipped) == (23, 0)
    cycle.skip_until(32)
    release(bus, 35)
    assert (cycle.wait(), cycle.skipped) == (35, 0)


@WAKES
def test_a_late_task_skips_passed_releases_and_counts_them(bus: Segment) -> None:
    cycle = NextCycle(bus, "level")
    # The first one counts from tick 0.
    release(bus, 4)
    assert (cycle.wait(), cycle.skipped) == (4, 1)
    for tick in (8, 12, 16):
        release(bus, tick)
    assert (cycle.wait(), cycle.skipped) == (16, 2)
    release(bus, 20)
    assert (cycle.wait(), cycle.skipped) == (20, 0)
    # The last release is taken, however late.
    release(bus, 24)
    bus.words[System.STATE] = Run.STOPPED
    assert (cycle.wait(), cycle.skipped) == (24, 0)
    assert cycle.wait() is None


@pytest.mark.parametrize(("releases", "skipped"), [((4, 8, 12), 0), ((20,), 2)])
def test_a_busy_planner_takes_no_release_and_skips_none(
    bus: Segment, releases: tuple[int, ...], skipped: int
) -> None:
    cycle = NextCycle(bus, "level")
    release(bus, 0)
    cycle.wait()
    cycle.skip_until(12)
    for tick in releases:
        release(bus, tick)
    assert (cycle.wait(), cycle.skipped) == (releases[-1], skipped)


@pytest.mark.parametrize(
    ("newest", "taken", "skipped"), [(4, 4, 0), (12, 4, 0), (16, 8, 1), (40, 32, 7)]
)
def test_a_planner_takes_a_late_release_as_of_its_tick_within_its_slice(
    make_bus: MakeBus, newest: int, taken: int, skipped: int
) -> None:
    segment = make_bus(task("level", every=EVERY, within_cycles=3))
    cycle = NextCycle(segment, "level")
    release(segment, 0)
    cycle.wait()
    release(segment, newest)
    assert (cycle.wait(), cycle.skipped) == (taken, skipped)
    # The releases after it come one by one.
    assert [cycle.wait() for _ in range((newest - taken) // EVERY)] == list(
        range(taken + EVERY, newest + 1, EVERY)
    )


@pytest.mark.parametrize(("done", "skipped"), [(8, 0), (4, 1), (-1, 3)])
def test_a_restarted_task_waits_for_the_next_release_and_has_skipped_those_without_a_cycle(
    bus: Segment, done: int, skipped: int
) -> None:
    release(bus, 8)
    bus.get_block("level")[Block.DONE] = done
    cycle = NextCycle(bus, "level")
    release(bus, 12)
    assert (cycle.wait(), cycle.skipped) == (12, skipped)


@WAKES
def test_the_end_of_the_run_ends_a_wait(bus: Segment) -> None:
    found: list[int | None] = [-1]
    with in_thread(lambda: found.append(NextCycle(bus, "level").wait())):
        bus.words[System.STATE] = Run.STOPPED
        get_wake_semaphore(bus, "level").release()
    assert found == [-1, None]


@pytest.mark.slow
@WAKES
def test_the_launchers_end_ends_a_wait(bus: Segment) -> None:
    bus.release_launcher_lock()
    assert NextCycle(bus, "level").wait() is None


def publish(segment: Segment, tick: int) -> None:
    """Release the task as a clock does that is in time: without a post."""
    segment.get_block("level")[Block.RELEASED] = tick


TIMER = pytest.mark.parametrize("wake", ["timer"], indirect=True)


@TIMER
def test_a_sleeping_task_takes_a_release_at_its_grid_point_and_not_before(bus: Segment) -> None:
    cycle = NextCycle(bus, "level")
    start_grid(bus, -4 * PERIOD_NS)
    publish(bus, 0)
    for tick in range(0, 10 * EVERY, EVERY):
        assert (cycle.wait(), cycle.skipped) == (tick, 0)
        assert time.monotonic_ns() >= bus.words[System.EPOCH_NS] + tick * PERIOD_NS
        publish(bus, tick + EVERY)


@TIMER
def test_a_sleeping_task_sleeps_until_its_next_grid_point_if_the_clock_skips_one(
    bus: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    cycle = NextCycle(bus, "level")
    start_grid(bus, -PERIOD_NS)
    publish(bus, 0)
    assert cycle.wait() == 0

    pause = cycle._pause

    def skip_and_pause() -> bool:
        # Once the task has found nothing at its grid point, the clock works ahead of the next one.
        if time.monotonic_ns() >= bus.words[System.EPOCH_NS] + EVERY * PERIOD_NS:
            publish(bus, 2 * EVERY)
        return pause()

    monkeypatch.setattr(cycle, "_pause", skip_and_pause)
    assert (cycle.wait(), cycle.skipped) == (2 * EVERY, 1)
    assert time.monotonic_ns() >= bus.words[System.EPOCH_NS] + 2 * EVERY * PERIOD_NS


@TIMER
def test_a_release_that_the_clock_makes_up_for_after_a_skip_wakes_a_sleeping_task(
    bus: Segment,
) -> None:
    cycle, post = NextCycle(bus, "level"), get_wake_semaphore(bus, "level")
    # Half an hour ahead of the grid point of tick 5, however long this takes.
    start_grid(bus, 5 * HOUR_NS - HOUR_NS // 2, HOUR_NS)
    driver = RealtimeDriver(bus, lambda tick: None)
    driver._release_tasks(0, -1)
    assert (post.try_acquire(), cycle.wait(), cycle.skipped) == (True, 0, 0)
    # The tick of the task's release was skipped. The task has found nothing at its grid point.
    driver._release_tasks(EVERY + 1, EVERY - 1)
    assert (post.value, cycle.wait(), cycle.skipped) == (1, EVERY, 0)
    assert post.try_acquire()
    # On time, it finds its release by itself.
    driver._release_tasks(2 * EVERY, 2 * EVERY - 1)
    assert post.value == 0
    start_grid(bus, 2 * EVERY * HOUR_NS, HOUR_NS)
    assert (cycle.wait(), cycle.skipped) == (2 * EVERY, 0)


@TIMER
def test_a_sleeping_task_woken_late_takes_the_release_that_passed_not_the_one_ahead(
    bus: Segment,
) -> None:
    cycle = NextCycle(bus, "level")
    start_grid(bus, -PERIOD_NS)
    publish(bus, 0)
    assert cycle.wait() == 0
    # The task is kept from its core from its first grid point to shortly before its second: a clock
    # that works ahead has released both.
    start_grid(bus, 2 * EVERY * HOUR_NS - HOUR_NS, HOUR_NS)
    publish(bus, 2 * EVERY)
    assert (cycle.wait(), cycle.skipped) == (EVERY, 0)
    # An hour later.
    start_grid(bus, 2 * EVERY * HOUR_NS, HOUR_NS)
    assert (cycle.wait(), cycle.skipped) == (2 * EVERY, 0)


@pytest.mark.parametrize("wake", ["signal", "timer"], indirect=True)
def test_releases_given_at_once_in_lockstep_are_taken_one_after_the_other(bus: Segment) -> None:
    bus.words[System.LOCKSTEP] = 1
    # A grid in the far future: it does not count, for a task that sleeps neither.
    start_grid(bus, -1_000 * EVERY * PERIOD_NS)
    block = bus.get_block("level")
    cycle = NextCycle(bus, "level")
    release(bus, 0)
    seen = [(cycle.wait(), cycle.skipped)]
    block[Block.FIRST] = 4
    release(bus, 12)
    seen += [(cycle.wait(), cycle.skipped) for _ in range(3)]
    assert seen == [(0, 0), (4, 0), (8, 0), (12, 0)]
    # Continued late: what has passed is skipped.
    block[Block.FIRST] = 24
    release(bus, 28)
    assert [(cycle.wait(), cycle.skipped) for _ in range(2)] == [(24, 2), (28, 0)]
    assert get_wake_semaphore(bus, "level").value == 0


@pytest.mark.filterwarnings(FORKS)
@pytest.mark.parametrize("wake", ["signal", "timer"], indirect=True)
def test_a_clock_that_stops_again_is_reported_again(bus: Segment) -> None:
    start_grid(bus)
    cycle = NextCycle(bus, "level", clock_alarms=AlarmWriter(bus, "level"))
    ring = open_alarm_ring(bus, "level")
    release(bus, 0)
    cycle.wait()
    with forked(signal.pause) as pid:
        os.kill(pid, signal.SIGSTOP)
        bus.words[System.CLOCK_PID] = pid
        for tick in (4, 8):
            with in_thread(cycle.wait):
                wait_until(lambda: ring.waiting_count > 0)
                assert Alarm(ring.read_new_rows().rows["code"][0]) is Alarm.CLOCK_STOPPED
                release(bus, tick)
