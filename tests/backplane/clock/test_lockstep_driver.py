"""The clock in lockstep: a tick begins when every due task has finished."""

from __future__ import annotations

import os
import signal
import sys
import time
from contextlib import ExitStack
from functools import partial
from types import SimpleNamespace
from typing import get_args

import pytest

from rack.backplane import process
from rack.backplane.clock.lockstep import MAX_BATCH_TICKS, LockstepDriver
from rack.backplane.clock.wake import NextCycle
from rack.backplane.layout import Wake
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_done_semaphore
from rack.backplane.words import Block, Run, System
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, forked, in_thread

pytestmark = pytest.mark.filterwarnings(FORKS)
HISTORY = 8


def serve(
    segment: Segment, name: str, cycle: NextCycle, log: list[tuple[str, str, int]], work_s: float
) -> None:
    """Run a task's cycles slowly, and report each to the clock."""
    block = segment.get_block(name)
    while (tick := cycle.wait()) is not None:
        log.append(("begin", name, tick))
        time.sleep(work_s)
        log.append(("end", name, tick))
        block[Block.DONE] = tick
        get_done_semaphore(segment, name).release()


def lockstep(
    segment: Segment, stop: int, one_at_a_time: bool, flooded: bool = False
) -> tuple[list[tuple[str, str, int]], list[int]]:
    """Run lockstep over slow tasks; return the log of their cycles, and the ticks in the order
    given out."""
    log: list[tuple[str, str, int]] = []
    ticks: list[int] = []

    def ended(tick: int) -> int | None:
        ticks.append(tick)
        log.append(("tick", "clock", tick))
        return stop if tick >= stop else None

    segment.words[System.LOCKSTEP] = 1
    # Ready before the first release: a task that is late waits for the next one.
    cycles = {t: NextCycle(segment, t.name) for t in segment.layout.tasks}
    driver = LockstepDriver(segment, ended, one_at_a_time, HISTORY)
    driver.is_flooded = flooded
    with ExitStack() as served:
        for t, cycle in cycles.items():
            work = partial(serve, segment, t.name, cycle, log, 0.002 * t.slot)
            served.enter_context(in_thread(work))
        driver.run()
    return log, ticks


@pytest.mark.parametrize("wake", get_args(Wake))
def test_a_lockstep_tick_begins_when_every_task_due_has_finished(
    make_bus: MakeBus, wake: Wake
) -> None:
    segment = make_bus(task("fast", slot=2, wake=wake), task("slow", every=4, slot=5, wake=wake))
    log, ticks = lockstep(segment, 12, False)
    assert ticks == list(range(13))
    words = (System.TICK, System.STOP_TICK, System.STATE)
    assert [segment.words[word] for word in words] == [11, 12, Run.STOPPED]
    for name, period in {"fast": 1, "slow": 4}.items():
        assert [tick for what, who, tick in log if (what, who) == ("begin", name)] == list(
            range(0, 12, period)
        )
        for tick in range(0, 12 - period, period):
            assert log.index(("end", name, tick)) < log.index(("tick", "clock", tick + period))


@pytest.mark.slow
@pytest.mark.parametrize("flooded", [False, True])
@pytest.mark.parametrize("wake", get_args(Wake))
def test_tasks_run_one_after_the_other_if_configured(
    make_bus: MakeBus, wake: Wake, flooded: bool
) -> None:
    planner = task("planner", slot=4, role="planner", wake=wake)
    segment = make_bus(
        planner, task("slow", every=2, slot=3, wake=wake), task("fast", slot=2, wake=wake)
    )
    log, _ = lockstep(segment, 6, not flooded, flooded)
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
    monkeypatch.setattr("rack.backplane.clock.wake.CHECK_NS", 1_000_000)
    log, _ = lockstep(make_bus(task("first", slot=9), task("second", slot=10)), 3, True)
    assert [name for what, name, _ in log if what == "begin"] == ["first", "second"] * 3
    assert log.index(("end", "first", 1)) < log.index(("begin", "second", 1))


def test_lockstep_waits_without_a_bound_for_a_recorder_that_lives(
    make_bus: MakeBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Each look at it takes a second: it is waited for longer than for any that is dead.
    quick = SimpleNamespace(
        monotonic=lambda: 1000 * time.monotonic(), monotonic_ns=time.monotonic_ns, sleep=time.sleep
    )
    monkeypatch.setattr("rack.backplane.clock.lockstep.time", quick)
    segment = make_bus(task("fast"))
    looks = 0

    def state_of(pid: int) -> str:
        nonlocal looks
        looks += 1
        if looks == 100:
            segment.words[System.FOLLOWER_TICK] = 3 * HISTORY
        return process.read_state(pid)

    monkeypatch.setattr("rack.backplane.clock.lockstep.read_state", state_of)
    with forked(signal.pause) as follower:
        segment.words[System.FOLLOWER_PID] = follower
        _, ticks = lockstep(segment, 3 * HISTORY, False)
    assert looks == 100
    assert len(ticks) == 3 * HISTORY + 1
    assert segment.words[System.FOLLOWER_PID] == follower


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["dead", "stopped"])
def test_the_wait_for_a_dead_recorder_is_bounded(
    make_bus: MakeBus, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    monkeypatch.setattr("rack.backplane.clock.lockstep.MAX_RECORDER_WAIT_S", 0.05)
    segment = make_bus(task("fast"))
    with forked(signal.pause) as follower:
        os.kill(follower, number)
        segment.words[System.FOLLOWER_PID] = follower
        _, ticks = lockstep(segment, 3 * HISTORY, False)
    assert len(ticks) == 3 * HISTORY + 1
    assert segment.words[System.FOLLOWER_PID] == 0


def test_a_stop_ends_lockstep_though_a_task_hangs(make_bus: MakeBus) -> None:
    segment = make_bus(task("fast"))
    with in_thread(LockstepDriver(segment, lambda tick: None, False, HISTORY).run):
        segment.words[System.STOP_REQUEST] = 1
    assert segment.words[System.STATE] == Run.STOPPED


@pytest.mark.parametrize(
    ("ticks", "drained", "flooded", "is_ahead"),
    [
        (HISTORY, 0, False, False),
        (HISTORY + 1, 0, False, True),
        (5, 3, True, True),
        (5, 4, True, False),
        (5, 3, False, False),
    ],
)
def test_the_lead_of_the_clock_over_its_recorder_is_bounded(
    make_bus: MakeBus, ticks: int, drained: int, flooded: bool, is_ahead: bool
) -> None:
    segment = make_bus(task("level"))
    driver = LockstepDriver(segment, lambda tick: None, False, HISTORY)
    segment.words[System.FOLLOWER_TICK] = 0
    segment.words[System.FOLLOWER_DRAINED] = drained
    driver.is_flooded = flooded
    assert driver._is_recorder_behind(ticks) is is_ahead


def idle_driver(segment: Segment, until: int = sys.maxsize) -> LockstepDriver:
    """Return a driver whose controller has no work before a tick."""
    driver = LockstepDriver(segment, lambda tick: None, False, HISTORY)
    driver.controller = SimpleNamespace(find_next_work_tick=lambda tick: until)
    return driver


def test_an_executor_that_alone_is_due_gets_its_ticks_at_once(make_bus: MakeBus) -> None:
    segment = make_bus(task("fast", slot=2), task("slow", every=6, slot=3))
    segment.words[System.LOCKSTEP] = 1
    log: list[tuple[str, str, int]] = []
    cycles = {name: NextCycle(segment, name) for name in ("fast", "slow")}
    driver = LockstepDriver(segment, lambda tick: 15, False, HISTORY)
    worked_at = list[int]()
    driver.controller = SimpleNamespace(
        begin_tick=worked_at.append,
        finish_release=id,
        find_next_work_tick=lambda tick: sys.maxsize,
    )
    with (
        in_thread(lambda: serve(segment, "fast", cycles["fast"], log, 0.0)),
        in_thread(lambda: serve(segment, "slow", cycles["slow"], log, 0.02)),
    ):
        driver.run()
    assert worked_at == [0, 1, 6, 7, 12, 13]
    begun = {
        name: [at for what, who, at in log if (what, who) == ("begin", name)] for name in cycles
    }
    assert begun == {"fast": list(range(15)), "slow": [0, 6, 12]}
    for tick in (6, 12):
        assert log.index(("end", "slow", tick - 6)) < log.index(("begin", "fast", tick))
        assert log.index(("end", "fast", tick - 1)) < log.index(("begin", "slow", tick))
    assert segment.words[System.TICK] == 14


@pytest.mark.parametrize(
    ("word", "value", "end"),
    [
        (System.STOP_TICK, 0, 1 + MAX_BATCH_TICKS),
        (System.STOP_TICK, 4, 4),
        # It holds before tick 5.
        (System.HOLD_AT, 6, 5),
        (System.HOLD_AT, 1, 2),
    ],
)
def test_a_batch_ends_at_the_end_of_the_run_or_at_a_hold(
    make_bus: MakeBus, word: int, value: int, end: int
) -> None:
    segment = make_bus(task("fast", slot=2), task("slow", every=40, slot=3))
    driver = idle_driver(segment)
    driver._wait_for_tick(0)
    segment.words[word] = value
    assert driver._find_batch_end(driver.list_due_tasks(1, 0), 1) == end


@pytest.mark.parametrize(("snapshot_at", "end"), [(sys.maxsize, 7), (4, 4), (1, 2)])
def test_a_batch_ends_before_the_next_work_of_the_clock_or_the_next_snapshot(
    make_bus: MakeBus, snapshot_at: int, end: int
) -> None:
    segment = make_bus(task("fast", slot=2), task("slow", every=40, slot=3))
    driver = idle_driver(segment, until=7)
    called_at = []

    def snapshot(tick: int) -> int:
        called_at.append(tick)
        return snapshot_at

    driver.snapshot = snapshot
    driver._wait_for_tick(1)
    assert driver._find_batch_end(driver.list_due_tasks(1, 0), 1) == end
    for tick in range(2, 6):
        driver._wait_for_tick(tick)
    assert called_at == [1, *(tick for tick in range(2, 6) if tick >= snapshot_at)]


def test_a_planner_several_tasks_and_one_that_is_stopped_get_one_tick_each(
    make_bus: MakeBus,
) -> None:
    planner = task("planner", slot=4, role="planner")
    segment = make_bus(task("fast", slot=2), task("also", every=2, slot=3), planner)
    driver = idle_driver(segment)
    driver._wait_for_tick(0)
    assert driver._find_batch_end(driver.list_due_tasks(2, 1), 2) == 3
    assert driver._find_batch_end([], 1) == 2
    fast, also, thinking = driver.tasks
    assert [driver._find_batch_end([one], 2) for one in (fast, also, thinking)] == [3, 3, 3]
    also.deadline = thinking.deadline = 20
    assert driver._find_batch_end([fast], 1) == 1 + MAX_BATCH_TICKS
    fast.deadline = 20
    assert [driver._find_batch_end([one], 1) for one in (also, thinking)] == [2, 2]
    fast.is_stopped = True
    assert driver._find_batch_end([fast], 1) == 2


def test_a_restarted_clock_waits_for_the_batch_of_its_predecessor(make_bus: MakeBus) -> None:
    segment = make_bus(task("fast"))
    words, block = segment.words, segment.get_block("fast")
    words[System.LOCKSTEP] = 1
    words[System.STATE] = Run.RUNNING
    words[System.TICK] = 3
    block[Block.RELEASED] = 6
    block[Block.DEADLINE] = 7
    block[Block.DONE] = 3
    asked: list[int] = []

    def ended(tick: int) -> int:
        asked.append(block[Block.DONE])
        return tick

    with in_thread(LockstepDriver(segment, ended, False, HISTORY).run):
        block[Block.DONE] = 6
        get_done_semaphore(segment, "fast").release()
    assert asked
    assert set(asked) == {6}
