"""The system controller: ticks on the grid in real time, ticks when all is done in lockstep."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise

import pytest

from backplane.clock_driver import ClockDriver, Ended, LockstepDriver, RealtimeDriver, by_priority
from backplane.segment import Segment
from backplane.semaphores import clock_semaphore, wake_semaphore
from backplane.wake import NextCycle
from backplane.words import Block, Head, Run, System
from tests.backplane.bus import layout, task
from tests.backplane.conftest import MakeBus
from tests.processes import BOUND_S, FORKS, exit_status, fork

pytestmark = pytest.mark.filterwarnings(FORKS)
PERIOD_NS = 1_000_000
HISTORY = 8


def start(segment: Segment, lead_ns: int = 3 * PERIOD_NS) -> None:
    segment.words[System.PERIOD_NS] = PERIOD_NS
    segment.words[System.EPOCH_NS] = time.monotonic_ns() + lead_ns


def given_out(segment: Segment, stop: int, meanwhile: Callable[[int], object] = id) -> list[tuple[int, int]]:
    """Run the clock in real time up to `stop`; return every tick with the time at which it was decided on."""
    ticks: list[tuple[int, int]] = []

    def ended(tick: int) -> int | None:
        ticks.append((tick, time.monotonic_ns()))
        meanwhile(tick)
        return stop if tick >= stop else None

    RealtimeDriver(segment, ended).run()
    return ticks


def test_no_tick_comes_before_its_grid_point(make_bus: MakeBus) -> None:
    segment = make_bus()
    start(segment)
    epoch = segment.words[System.EPOCH_NS]
    ticks = given_out(segment, 40)
    assert all(at >= epoch + tick * PERIOD_NS for tick, at in ticks)
    assert all(first < second for (first, _), (second, _) in pairwise(ticks))


def test_a_run_stops_at_its_tick_and_wakes_everybody(make_bus: MakeBus) -> None:
    segment = make_bus()
    start(segment)
    posts = [wake_semaphore(segment.rack, name) for name in ("writer", "reader")]
    ticks = given_out(segment, 10)
    assert segment.words[System.TICK] < 10 <= ticks[-1][0]
    assert len(ticks) > 1
    assert (segment.words[System.STATE], segment.words[System.STOP_TICK]) == (Run.STOPPED, 10)
    released = len(ticks) - 1
    assert [post.value for post in posts] == [released + 1] * 2


def test_a_late_clock_leaves_ticks_out_and_counts_them(make_bus: MakeBus) -> None:
    segment, held_up = make_bus(), []

    def hold_up(tick: int) -> None:
        if tick >= 10 and not held_up:
            held_up.append(tick)
            time.sleep(0.006)

    start(segment)
    numbers = [tick for tick, _ in given_out(segment, 30, hold_up)]
    behind = numbers[numbers.index(held_up[0]) + 1]
    assert behind - held_up[0] >= 6
    left_out = sum(second - first - 1 for first, second in pairwise([-1, *numbers]))
    assert segment.words[System.CLOCK_SKIPPED] == left_out


def test_a_clock_that_starts_late_does_not_shift_its_grid(make_bus: MakeBus) -> None:
    segment = make_bus()
    start(segment, -10 * PERIOD_NS)
    first = given_out(segment, 30)[0][0]
    assert first >= 10
    assert segment.words[System.CLOCK_SKIPPED] >= first


def test_a_task_is_released_at_its_own_grid_points(make_bus: MakeBus) -> None:
    segment = make_bus(task("fast"), task("slow", every=4, slot=3))
    start(segment)
    fast, slow, seen = segment.block("fast"), segment.block("slow"), []
    ticks = given_out(segment, 40, lambda tick: seen.append((fast[Block.RELEASED], slow[Block.RELEASED])))
    # What is seen at a tick is what the tick before it released, also where ticks were left out.
    before = [tick for tick, _ in ticks][:-1]
    assert seen == [(-1, -1), *((tick, tick - tick % 4) for tick in before)]


def test_nothing_is_released_to_a_planner_within_its_time_slice(make_bus: MakeBus) -> None:
    segment = make_bus(task("fast"), task("planner", slot=3))
    start(segment)
    block, released = segment.block("planner"), []
    end_of_slice = 20

    def plan(tick: int) -> None:
        if released or block[Block.RELEASED] >= 3:
            released.append(block[Block.RELEASED])
            block[Block.DEADLINE] = max(end_of_slice, block[Block.DEADLINE])

    ticks = [tick for tick, _ in given_out(segment, 40, plan)][-len(released) :]
    # What is seen at a tick is what the tick before it released.
    within = [seen for tick, seen in zip(ticks[1:], released, strict=False) if tick < end_of_slice]
    assert set(within) == {released[0]}
    assert released[-1] > end_of_slice


@pytest.mark.parametrize("driver", ["realtime", "lockstep"])
def test_a_clock_without_a_launcher_ends(make_bus: MakeBus, driver: str) -> None:
    segment = make_bus()
    start(segment)
    segment.words[Head.LAUNCHER_START] += 1
    never: Ended = lambda tick: None  # noqa: E731
    clock: ClockDriver = RealtimeDriver(segment, never)
    if driver == "lockstep":
        clock = LockstepDriver(segment, never, False, HISTORY)
    with in_thread(clock.run):
        pass
    assert segment.words[System.STATE] == Run.STOPPED


def test_a_stop_requested_from_outside_ends_at_the_next_tick(make_bus: MakeBus) -> None:
    segment = make_bus()
    start(segment)

    def request(tick: int) -> None:
        segment.words[System.STOP_REQUEST] |= tick >= 5

    ticks = given_out(segment, 10_000, request)
    stopped = segment.words[System.STOP_TICK]
    assert stopped > segment.words[System.TICK] >= 5
    assert stopped > ticks[-1][0]


@contextmanager
def in_thread(run: Callable[[], None]) -> Iterator[None]:
    """Run something beside the test; at the end it must come to its own end."""
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield
    thread.join(BOUND_S)
    assert not thread.is_alive()


def serve(segment: Segment, name: str, log: list[tuple[str, str, int]], work_s: float, poll: bool) -> None:
    """Do a task's cycles, slowly, and tell the clock of each."""
    cycle, block = NextCycle(segment, name, poll), segment.block(name)
    while (tick := cycle.wait()) is not None:
        log.append(("begin", name, tick))
        time.sleep(work_s)
        log.append(("end", name, tick))
        block[Block.DONE] = tick
        clock_semaphore(segment.rack).release()


def lockstep(
    segment: Segment, stop: int, one_at_a_time: bool, poll: bool = False
) -> tuple[list[tuple[str, str, int]], list[int]]:
    """Run lockstep over slow tasks; return the log of their cycles, and the ticks in the order given out."""
    log: list[tuple[str, str, int]] = []
    ticks: list[int] = []

    def ended(tick: int) -> int | None:
        ticks.append(tick)
        log.append(("tick", "clock", tick))
        return stop if tick >= stop else None

    segment.words[System.LOCKSTEP] = 1
    threads = [
        threading.Thread(target=serve, args=(segment, t.name, log, 0.002 * t.slot, poll), daemon=True)
        for t in segment.layout.tasks
    ]
    for thread in threads:
        thread.start()
    LockstepDriver(segment, ended, one_at_a_time, HISTORY).run()
    for thread in threads:
        thread.join(BOUND_S)
        assert not thread.is_alive()
    return log, ticks


def test_lockstep_gives_out_every_tick_once(make_bus: MakeBus) -> None:
    segment = make_bus(task("fast", slot=2), task("slow", every=4, slot=3))
    _, ticks = lockstep(segment, 13, False)
    assert ticks == list(range(14))
    assert [segment.words[w] for w in (System.TICK, System.STOP_TICK, System.STATE)] == [12, 13, Run.STOPPED]


@pytest.mark.parametrize("poll", [False, True])
def test_a_lockstep_tick_begins_when_every_task_due_has_finished(make_bus: MakeBus, poll: bool) -> None:
    segment = make_bus(task("fast", slot=2), task("slow", every=4, slot=5))
    log, _ = lockstep(segment, 12, False, poll)
    every = {"fast": 1, "slow": 4}
    for name, period in every.items():
        assert [tick for what, who, tick in log if (what, who) == ("begin", name)] == list(range(0, 12, period))
        for tick in range(0, 12 - period, period):
            assert log.index(("end", name, tick)) < log.index(("tick", "clock", tick + period))


@pytest.mark.parametrize("poll", [False, True])
def test_one_at_a_time_means_one_after_the_other(make_bus: MakeBus, poll: bool) -> None:
    planner = task("planner", slot=4, role="planner")
    segment = make_bus(planner, task("slow", every=2, slot=3), task("fast", slot=2))
    log, _ = lockstep(segment, 6, True, poll)
    expected: list[tuple[str, str, int]] = []
    for tick in range(6):
        expected.append(("tick", "clock", tick))
        due = ["fast", "slow", "planner"] if tick % 2 == 0 else ["fast", "planner"]
        expected += [(what, name, tick) for name in due for what in ("begin", "end")]
    assert log == [*expected, ("tick", "clock", 6)]


def test_a_task_that_waits_long_for_its_turn_does_not_begin_before_it(
    make_bus: MakeBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Waits end many times within one turn of the other task.
    monkeypatch.setattr("backplane.wake.CHECK_S", 0.001)
    segment = make_bus(task("first", slot=9), task("second", slot=10))
    log, _ = lockstep(segment, 3, True)
    names = [name for what, name, _ in log if what == "begin"]
    assert names == ["first", "second"] * 3
    assert log.index(("end", "first", 1)) < log.index(("begin", "second", 1))


def test_lockstep_waits_for_its_recorder(make_bus: MakeBus) -> None:
    segment = make_bus(task("fast"))
    segment.words[System.FOLLOWER_PID] = os.getpid()
    ahead: list[int] = []

    def ended(tick: int) -> int | None:
        ahead.append(tick - segment.words[System.FOLLOWER_TICK])
        return 100 if tick >= 100 else None

    def record() -> None:
        while segment.words[System.STATE] != Run.STOPPED:
            segment.words[System.FOLLOWER_TICK] = segment.words[System.TICK]
            time.sleep(0.0005)

    segment.words[System.LOCKSTEP] = 1
    with in_thread(lambda: serve(segment, "fast", [], 0, False)), in_thread(record):
        LockstepDriver(segment, ended, False, HISTORY).run()
    assert len(ahead) == 101
    assert max(ahead) <= HISTORY + 1


def test_a_dead_recorder_is_not_waited_for(make_bus: MakeBus) -> None:
    segment = make_bus(task("fast"))
    gone = fork(lambda: None)
    assert exit_status(gone) == 0
    segment.words[System.FOLLOWER_PID] = gone
    _, ticks = lockstep(segment, 3 * HISTORY, False)
    assert len(ticks) == 3 * HISTORY + 1
    assert segment.words[System.FOLLOWER_PID] == 0


def test_a_stop_ends_lockstep_though_a_task_hangs(make_bus: MakeBus) -> None:
    segment = make_bus(task("fast"))
    with in_thread(LockstepDriver(segment, lambda tick: None, False, HISTORY).run):
        segment.words[System.STOP_REQUEST] = 1
    assert segment.words[System.STATE] == Run.STOPPED


def test_executors_go_before_planners_and_the_faster_first() -> None:
    tasks = [
        task("planner", every=1, slot=2, role="planner"),
        task("slow", every=8, slot=3),
        task("right", every=1, slot=5),
        task("left", every=1, slot=4),
    ]
    assert [t.name for t in by_priority(layout("any", (), tasks))] == ["left", "right", "slow", "planner"]
