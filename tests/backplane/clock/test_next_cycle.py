"""Waiting for the next cycle: on the grid, skipping passed releases, and within a bound."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable

import pytest

from rack.backplane.clock.wake import NextCycle
from rack.backplane.process import state_of
from rack.backplane.segment import Segment
from rack.backplane.semaphores import wake_semaphore
from rack.backplane.watch.alarms import Alarm, AlarmWriter, alarm_ring
from rack.backplane.words import Block, Head, Run, System
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus
from tests.processes import BOUND_S, FORKS, forked, in_thread, wait_until

POLL = pytest.mark.parametrize("poll", [False, True], ids=["signal", "poll"])
EVERY = 4


@pytest.fixture
def bus(make_bus: MakeBus) -> Segment:
    return make_bus(task("level", every=EVERY))


def release(segment: Segment, tick: int) -> None:
    segment.block("level")[Block.RELEASED] = tick
    wake_semaphore(segment.rack, "level").release()


@POLL
def test_a_release_is_given_once(bus: Segment, poll: bool) -> None:
    cycle, seen = NextCycle(bus, "level", poll), []
    for tick in (0, 4, 8):
        release(bus, tick)
        seen.append((cycle.wait(), cycle.skipped))
    assert seen == [(0, 0), (4, 0), (8, 0)]


@POLL
def test_a_late_task_skips_passed_releases_and_counts_them(bus: Segment, poll: bool) -> None:
    cycle = NextCycle(bus, "level", poll)
    release(bus, 0)
    cycle.wait()
    for tick in (4, 8, 12):
        release(bus, tick)
    assert (cycle.wait(), cycle.skipped) == (12, 2)
    release(bus, 16)
    assert (cycle.wait(), cycle.skipped) == (16, 0)


def test_the_first_release_counts_from_tick_0(bus: Segment) -> None:
    cycle = NextCycle(bus, "level")
    release(bus, 8)
    assert (cycle.wait(), cycle.skipped) == (8, 2)


def test_a_planner_at_work_takes_no_release_and_skips_none(bus: Segment) -> None:
    cycle = NextCycle(bus, "level")
    release(bus, 0)
    cycle.wait()
    cycle.hold_until(12)
    for tick in (4, 8, 12):
        release(bus, tick)
    assert (cycle.wait(), cycle.skipped) == (12, 0)


def test_a_planner_that_comes_late_counts_from_the_end_of_its_slice(bus: Segment) -> None:
    cycle = NextCycle(bus, "level")
    release(bus, 0)
    cycle.wait()
    cycle.hold_until(12)
    release(bus, 20)
    assert (cycle.wait(), cycle.skipped) == (20, 2)


@pytest.mark.parametrize(("newest", "taken", "skipped"), [(4, 4, 0), (12, 4, 0), (16, 8, 1), (40, 32, 7)])
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
    assert [cycle.wait() for _ in range((newest - taken) // EVERY)] == list(range(taken + EVERY, newest + 1, EVERY))


def test_a_restarted_task_waits_for_the_next_release(bus: Segment) -> None:
    release(bus, 8)
    cycle = NextCycle(bus, "level")
    release(bus, 12)
    assert (cycle.wait(), cycle.skipped) == (12, 0)


@POLL
def test_the_end_of_the_run_ends_a_wait(bus: Segment, poll: bool) -> None:
    found: list[int | None] = [-1]
    thread = threading.Thread(target=lambda: found.append(NextCycle(bus, "level", poll).wait()), daemon=True)
    thread.start()
    bus.words[System.STATE] = Run.STOPPED
    wake_semaphore(bus.rack, "level").release()
    thread.join(BOUND_S)
    assert found == [-1, None]


@POLL
def test_a_task_late_for_the_last_release_still_takes_it(bus: Segment, poll: bool) -> None:
    cycle = NextCycle(bus, "level", poll)
    for tick in (0, 4, 8):
        release(bus, tick)
    bus.words[System.STATE] = Run.STOPPED
    assert (cycle.wait(), cycle.skipped) == (8, 2)
    assert cycle.wait() is None


@POLL
def test_the_launchers_end_ends_a_wait(bus: Segment, poll: bool) -> None:
    bus.words[Head.LAUNCHER_START] += 1
    assert NextCycle(bus, "level", poll).wait() is None


def busy() -> None:
    while True:
        pass


@pytest.mark.filterwarnings(FORKS)
@pytest.mark.parametrize(("clock", "rung"), [(busy, []), (signal.pause, [Alarm.CLOCK_STOPPED])])
def test_a_clock_without_ticks_is_stopped_only_when_it_could_not_run(
    bus: Segment, monkeypatch: pytest.MonkeyPatch, clock: Callable[[], None], rung: list[Alarm]
) -> None:
    monkeypatch.setattr("rack.backplane.clock.wake.CLOCK_SILENT_S", 0.05)
    looks: list[int] = []
    monkeypatch.setattr("rack.backplane.clock.wake.state_of", lambda pid: looks.append(pid) or state_of(pid))
    bus.words[System.PERIOD_NS], bus.words[System.EPOCH_NS] = 2_500_000, time.monotonic_ns()
    cycle = NextCycle(bus, "level", clock_alarms=AlarmWriter(bus, "level"))
    release(bus, 0)
    cycle.wait()
    with forked(clock) as pid:
        bus.words[System.CLOCK_PID] = pid
        with in_thread(cycle.wait):
            # The checks a tenth of a second apart or more.
            wait_until(lambda: len(looks) > 60)
            bus.words[System.STATE] = Run.STOPPED
            wake_semaphore(bus.rack, "level").release()
    assert [Alarm(code) for code in alarm_ring(bus, "level").drain().rows["code"]] == rung


@pytest.mark.filterwarnings(FORKS)
def test_a_clock_that_stops_again_is_reported_again(bus: Segment) -> None:
    bus.words[System.PERIOD_NS], bus.words[System.EPOCH_NS] = 2_500_000, time.monotonic_ns()
    cycle, ring = NextCycle(bus, "level", clock_alarms=AlarmWriter(bus, "level")), alarm_ring(bus, "level")
    release(bus, 0)
    cycle.wait()
    with forked(signal.pause) as pid:
        os.kill(pid, signal.SIGSTOP)
        bus.words[System.CLOCK_PID] = pid
        for tick in (4, 8):
            with in_thread(cycle.wait):
                wait_until(lambda: ring.waiting > 0)
                assert Alarm(ring.drain().rows["code"][0]) is Alarm.CLOCK_STOPPED
                release(bus, tick)


def test_posts_that_a_polling_task_does_not_need_do_not_add_up(bus: Segment) -> None:
    cycle = NextCycle(bus, "level", poll=True)
    for tick in range(0, 100 * EVERY, EVERY):
        release(bus, tick)
        if tick % 3:
            assert cycle.wait() == tick
    assert wake_semaphore(bus.rack, "level").value <= 1
