"""Heartbeats: a task without progress for longer than its bound hangs."""

from __future__ import annotations

import os
import signal

import pytest

from rack.backplane.address_map import CLOCK
from rack.backplane.process import WAITING_STATES, read_state
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, System
from rack.boards.crate import heartbeat
from rack.boards.crate.heartbeat import LOCKSTEP_S, Heartbeat
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, forked, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)

PERIOD_NS = 2_500_000
FAST, SLOW = "fast", "slow"


class Clock:
    """Stands for the module `time`: a moment that a test sets."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def bus(make_bus: MakeBus) -> Segment:
    segment = make_bus(task(FAST), task(SLOW, every=400, slot=3, within_cycles=2))
    segment.words[System.PERIOD_NS] = PERIOD_NS
    segment.words[System.STATE] = Run.RUNNING
    segment.words[System.LOCKSTEP] = 1
    return segment


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(heartbeat, "time", clock)
    return clock


def compute() -> None:
    """Never wait."""
    while True:
        pass


def run_on(segment: Segment, clock: Clock, seconds: float, *hanging: str) -> None:
    """Let time pass: all tasks but those are released and finish."""
    clock.now_s += seconds
    tick = segment.words[System.TICK] = segment.words[System.TICK] + round(
        seconds * 1e9 / PERIOD_NS
    )
    for name in (FAST, SLOW):
        block = segment.get_block(name)
        block[Block.RELEASED] = tick
        if name not in hanging:
            block[Block.DONE] = tick


def test_a_task_that_recovered_and_hangs_again_is_reported_again(
    bus: Segment, clock: Clock
) -> None:
    beat, found = Heartbeat(bus), []
    for hanging in ((FAST,), (), (FAST,)):
        run_on(bus, clock, 2 * LOCKSTEP_S, *hanging)
        found += beat.find_hanging()
    assert found == [FAST, FAST]


@pytest.mark.parametrize("is_lost", [True, False])
def test_a_lost_task_does_not_hang_and_in_real_time_the_clock_checks_tasks(
    bus: Segment, clock: Clock, is_lost: bool
) -> None:
    bus.words[System.LOCKSTEP], bus.get_block(FAST)[Block.LOST] = is_lost, is_lost
    beat = Heartbeat(bus)
    run_on(bus, clock, 2 * LOCKSTEP_S, FAST)
    assert beat.find_hanging() == []


def test_an_idle_task_does_not_hang(bus: Segment, clock: Clock) -> None:
    beat = Heartbeat(bus)
    for name in (FAST, SLOW):
        bus.get_block(name)[Block.RELEASED] = bus.get_block(name)[Block.DONE] = 8
    for _ in range(20):
        clock.now_s += 1.0
        bus.words[System.TICK] += 1
        assert beat.find_hanging() == []


def test_a_clock_that_waits_for_several_cycles_at_once_does_not_hang(
    bus: Segment, clock: Clock
) -> None:
    beat = Heartbeat(bus)
    bus.get_block(FAST)[Block.RELEASED] = 8
    with forked(signal.pause) as pid:
        wait_until(lambda: read_state(pid) in WAITING_STATES)
        bus.words[System.CLOCK_PID] = pid
        for tick in range(8):
            bus.get_block(FAST)[Block.DONE] = tick
            clock.now_s += LOCKSTEP_S / 2
            assert beat.find_hanging() == []


@pytest.mark.parametrize(
    ("doing", "number", "looks"),
    [
        ("is gone", 0, [[CLOCK], [], []]),
        ("computes", 0, [[], [], []]),
        ("waits", 0, [[], [CLOCK], []]),
        ("waits", signal.SIGSTOP, [[CLOCK], [], []]),
    ],
)
def test_a_silent_clock_hangs_only_where_it_is_gone_or_waits_or_was_stopped(
    bus: Segment, clock: Clock, doing: str, number: int, looks: list[list[str]]
) -> None:
    bus.words[System.LOCKSTEP] = 0
    with forked(compute if doing == "computes" else signal.pause) as pid:
        bus.words[System.CLOCK_PID] = 0 if doing == "is gone" else pid
        if number:
            os.kill(pid, number)
        state = "T" if number else "R" if doing == "computes" else "S"
        wait_until(lambda: read_state(pid) == state)
        beat = Heartbeat(bus)
        run_on(bus, clock, 0.5)
        assert beat.find_hanging() == []
        clock.now_s += 2.5
        assert [beat.find_hanging() for _ in range(3)] == looks


@pytest.mark.parametrize(
    ("state", "seconds"), [(Run.STARTING, 1000.0), (Run.STOPPED, 1000.0), (Run.RUNNING, 30.0)]
)
def test_no_task_hangs_before_or_after_the_run_or_during_a_long_plan_in_lockstep(
    bus: Segment, clock: Clock, state: Run, seconds: float
) -> None:
    beat = Heartbeat(bus)
    bus.words[System.STATE] = state
    clock.now_s += seconds
    assert beat.find_hanging() == []


def test_time_limits_are_longer_at_lower_speed(bus: Segment, clock: Clock) -> None:
    bus.words[System.PERIOD_NS], bus.words[System.LOCKSTEP] = 1000 * PERIOD_NS, 0
    beat = Heartbeat(bus)
    assert beat.find_hanging() == []
    clock.now_s += 9.0
    assert beat.find_hanging() == []
    clock.now_s += 2.0
    assert CLOCK in beat.find_hanging()


@pytest.mark.parametrize("doing", ["computes", "waits"])
def test_a_task_that_computes_in_lockstep_hangs_only_after_that_much_processor_time(
    bus: Segment, clock: Clock, monkeypatch: pytest.MonkeyPatch, doing: str
) -> None:
    with (
        forked(compute if doing == "computes" else signal.pause) as pid,
        forked(signal.pause) as waiting,
    ):
        bus.get_block(SLOW)[Block.PID], bus.words[System.CLOCK_PID] = pid, waiting
        wait_until(lambda: read_state(waiting) in WAITING_STATES)
        wait_until(lambda: read_state(pid) in ("R" if doing == "computes" else WAITING_STATES))
        beat, found = Heartbeat(bus), []
        bus.get_block(SLOW)[Block.RELEASED] = 1
        for _ in range(4):
            clock.now_s += LOCKSTEP_S
            found += beat.find_hanging()
        assert found == ([] if doing == "computes" else [SLOW])
        # Meanwhile the clock waits for the task, and does not hang.
        if doing == "computes":
            monkeypatch.setattr(beat, "_bound_s", 0.05)
            wait_until(lambda: beat.find_hanging() == [SLOW])
