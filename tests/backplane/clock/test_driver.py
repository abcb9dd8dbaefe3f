"""The clock in real time: ticks on the grid, and the order of releases."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from types import SimpleNamespace

import pytest

from rack.backplane.address_map import CLOCK
from rack.backplane.clock.driver import ClockDriver, FindEndTick, RealtimeDriver
from rack.backplane.clock.lockstep import LockstepDriver
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_wake_semaphore
from rack.backplane.watch.alarms import Alarm, open_alarm_ring
from rack.backplane.words import Block, Run, System
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus
from tests.processes import BOUND_S, in_thread

PERIOD_NS = 1_000_000
HISTORY = 8
STOP = 100
"""Enough ticks that a machine that is away for a while misses some, not all."""


def start(segment: Segment, lead_ns: int = 3 * PERIOD_NS) -> None:
    segment.words[System.PERIOD_NS] = PERIOD_NS
    segment.words[System.EPOCH_NS] = time.monotonic_ns() + lead_ns


def given_out(
    segment: Segment,
    stop: int,
    meanwhile: Callable[[int], object] = id,
    is_enough: Callable[[list[tuple[int, int]]], bool] = bool,
) -> list[tuple[int, int]]:
    """Run the clock in real time for `stop` ticks from its first one, which a stall of the machine
    may delay, or longer until the ticks are enough; return every tick with the time at which it was
    decided on."""
    ticks: list[tuple[int, int]] = []

    def ended(tick: int) -> int | None:
        ticks.append((tick, time.monotonic_ns()))
        end = ticks[0][0] + stop
        meanwhile(tick)
        return end if tick >= end and is_enough(ticks) else None

    RealtimeDriver(segment, ended).run()
    return ticks


def test_a_run_stops_at_its_tick_and_wakes_all_tasks(make_bus: MakeBus) -> None:
    segment = make_bus()
    start(segment)
    posts = [get_wake_semaphore(segment, name) for name in ("writer", "reader")]
    ticks = given_out(segment, STOP)
    epoch = segment.words[System.EPOCH_NS]
    assert all(at >= epoch + tick * PERIOD_NS for tick, at in ticks)
    assert all(first < second for (first, _), (second, _) in pairwise(ticks))
    stop = ticks[0][0] + STOP
    assert segment.words[System.TICK] < stop <= ticks[-1][0]
    assert len(ticks) > 1
    assert (segment.words[System.STATE], segment.words[System.STOP_TICK]) == (Run.STOPPED, stop)
    released = len(ticks) - 1
    assert [post.value for post in posts] == [released + 1] * 2


def test_the_clock_works_ahead_for_tasks_that_sleep(make_bus: MakeBus) -> None:
    segment = make_bus(task("sleeper", wake="timer"), task("waiter", slot=3))
    start(segment, 20 * PERIOD_NS)
    epoch, made = segment.words[System.EPOCH_NS], []
    sleeper, waiter = segment.get_block("sleeper"), segment.get_block("waiter")

    def take() -> None:
        post = get_wake_semaphore(segment, "waiter")
        while segment.words[System.STATE] != Run.STOPPED:
            if post.acquire(BOUND_S):
                # In this order: the clock may release both again between two reads.
                second, first = waiter[Block.RELEASED], sleeper[Block.RELEASED]
                made.append((first, second, time.monotonic_ns()))

    def is_ahead(ticks: list[tuple[int, int]]) -> bool:
        return any(at < epoch + tick * PERIOD_NS for tick, at in ticks)

    # On a busy machine the clock may be late for all of the first ticks.
    with in_thread(take):
        ticks = given_out(segment, 40, is_enough=is_ahead)
    # A task that waits for a signal is released at the grid point, where the others have found
    # their release.
    assert all(at >= epoch + second * PERIOD_NS and first >= second for first, second, at in made)
    # One post as the grid begins, one at the end; one more only for a tick of which the clock was
    # late.
    assert get_wake_semaphore(segment, "sleeper").value < 2 + len(ticks)


def test_a_clock_that_is_late_posts_the_tasks_that_sleep(make_bus: MakeBus) -> None:
    segment = make_bus(task("sleeper", wake="timer"))
    start(segment)
    # Every tick is decided on after its grid point.
    ticks = given_out(segment, 30, lambda tick: time.sleep(2 * PERIOD_NS * 1e-9))
    assert get_wake_semaphore(segment, "sleeper").value == 2 + len(ticks) - 1


def test_the_controller_works_before_and_after_the_releases_of_each_tick(
    make_bus: MakeBus,
) -> None:
    segment = make_bus(task("poller", wake="poll"))
    start(segment)
    work: list[tuple[str, int, bool]] = []
    # Both steps of one tick, however late the clock is for the others.
    driver = RealtimeDriver(segment, lambda tick: tick if tick >= STOP and len(work) > 2 else None)

    def note(step: str, tick: int) -> None:
        is_released = segment.get_block("poller")[Block.RELEASED] == tick
        work.append((step, tick, is_released))

    steps = {step: partial(note, step) for step in ("begin_tick", "finish_release")}
    driver.controller = SimpleNamespace(**steps)
    driver.run()
    ticks = [tick for step, tick, _ in work if step == "begin_tick"]
    both = [[("begin_tick", tick, False), ("finish_release", tick, True)] for tick in ticks]
    assert len(ticks) > 1
    assert work == [step for steps in both for step in steps]
    # A task that polls is released without a post: the one is the end's.
    assert get_wake_semaphore(segment, "poller").value == 1


def test_a_late_clock_skips_ticks_and_counts_them(make_bus: MakeBus) -> None:
    segment, held_up = make_bus(), []

    def hold_up(tick: int) -> None:
        if tick >= 10 and not held_up:
            held_up.append(tick)
            time.sleep(0.006)

    start(segment)
    # A machine that is away may leave out any number of ticks before and after it.
    ticks = given_out(segment, 30, hold_up, lambda ticks: ticks[-1][0] > held_up[0])
    numbers = [tick for tick, _ in ticks]
    following = numbers[numbers.index(held_up[0]) + 1]
    assert following - held_up[0] >= 6
    left_out = sum(second - first - 1 for first, second in pairwise([-1, *numbers]))
    assert segment.words[System.CLOCK_SKIPPED] == left_out
    # Its own gap is on record: since which tick it was due, and how much later it woke.
    rows, _ = open_alarm_ring(segment, CLOCK).read_new_rows()
    (late,) = [row for row in rows if row["since"] == held_up[0] + 1]
    assert (late["code"], late["tick"]) == (Alarm.CLOCK_LATE, following)
    least_ns = (following - held_up[0] - 1) * PERIOD_NS
    assert least_ns <= late["value"] < least_ns + PERIOD_NS


def test_a_late_clock_makes_the_last_tick_of_a_run(make_bus: MakeBus) -> None:
    segment, ticks = make_bus(), list[int]()

    def lag(tick: int) -> None:
        """Take six ticks for every one of a run."""
        ticks.append(tick)
        time.sleep(0.006)

    start(segment)
    # Known from the start: a machine that stalls before the first tick still makes the last one.
    segment.words[System.STOP_TICK] = 5
    driver = RealtimeDriver(segment, lambda _: None)
    driver.controller = SimpleNamespace(begin_tick=lag, finish_release=id)
    driver.run()
    assert ticks[-1] == 4
    assert segment.words[System.CLOCK_SKIPPED] == 5 - len(ticks)


def test_a_clock_that_starts_late_does_not_shift_its_grid(make_bus: MakeBus) -> None:
    segment = make_bus()
    start(segment, -10 * PERIOD_NS)
    first = given_out(segment, 30)[0][0]
    assert first >= 10
    assert segment.words[System.CLOCK_SKIPPED] >= first
    # Before its first tick nothing took its core.
    assert not any(row["since"] == 0 for row in open_alarm_ring(segment, CLOCK).read_new_rows()[0])


@pytest.mark.parametrize("skipped", [(), (5,), (4, 5, 6, 7, 8, 9, 10)])
def test_tasks_with_phases_have_their_own_releases_even_across_skipped_ticks(
    make_bus: MakeBus, skipped: tuple[int, ...]
) -> None:
    specs = [
        replace(task(f"t{phase}", every=4, slot=2 + phase), phase=phase) for phase in (0, 1, 3)
    ]
    driver = RealtimeDriver(make_bus(*specs), lambda _: None)
    last, found = -1, dict[str, list[int]]()
    for tick in (tick for tick in range(24) if tick not in skipped):
        for due in driver.list_due_tasks(tick, last):
            due.release(tick)
            found.setdefault(due.spec.name, []).append(due.block[Block.RELEASED])
        last = tick
    # A release that fell into skipped ticks comes at the first tick after them, unless a newer one
    # has come too.
    for spec in specs:
        releases = range(spec.phase, 24, 4)
        made = [next(t for t in range(release, 24 + 4) if t not in skipped) for release in releases]
        expected = [
            r
            for r, m, following in zip(releases, made, [*made[1:], 99], strict=True)
            if m < following
        ]
        assert found[spec.name] == expected


@pytest.mark.parametrize("driver", ["realtime", "lockstep"])
def test_a_clock_without_a_launcher_ends(make_bus: MakeBus, driver: str) -> None:
    segment = make_bus()
    start(segment)
    segment.release_launcher_lock()
    never: FindEndTick = lambda tick: None  # noqa: E731
    clock: ClockDriver = RealtimeDriver(segment, never)
    if driver == "lockstep":
        clock = LockstepDriver(segment, never, False, HISTORY)
    with in_thread(clock.run):
        pass
    assert segment.words[System.STATE] == Run.STOPPED
