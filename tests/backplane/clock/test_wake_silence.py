"""A stopped clock is found by a waiting task. An alarm needs proof, and a late clock gives none."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from rack.backplane.clock import wake
from rack.backplane.clock.wake import CLOCK_PATIENCE_TICKS, StoppedClockDetector
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter, open_alarm_ring
from rack.backplane.words import Run, System
from tests.backplane.conftest import MakeBus

PERIOD_NS = 2_500_000
EPOCH_NS = 1_000_000
CLOCK_PID = 4321
LONG = 200
"""Ticks of silence that a waiting clock is permitted: half a second."""


class Silence:
    """A task that waits for a clock, and the time, the clock's process and its ticks as the test
    says."""

    def __init__(self, segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
        self.words = segment.words
        self.words[System.EPOCH_NS] = EPOCH_NS
        self.words[System.PERIOD_NS] = PERIOD_NS
        self.words[System.CLOCK_PID] = CLOCK_PID
        self.now_ns = EPOCH_NS
        self.state = "R"
        self.while_asked: Callable[[], object] = lambda: None
        """What happens while the state of the clock's process is looked up."""
        for module in ("wake", "system_clock"):
            monkeypatch.setattr(f"rack.backplane.clock.{module}.monotonic_ns", lambda: self.now_ns)
        monkeypatch.setattr(wake, "read_state", self._state_of)
        self.clock = StoppedClockDetector(segment, AlarmWriter(segment, "reader"))
        self._ring = open_alarm_ring(segment, "reader")

    def _state_of(self, pid: int) -> str:
        assert pid == CLOCK_PID
        self.while_asked()
        return self.state

    def tick(self, tick: int) -> None:
        self.words[System.TICK] = tick

    def check(self, now: int) -> list[tuple[int, int, int, float, int]]:
        """Check the clock in the tick `now`; return the alarms: tick, code, subject, value and
        since."""
        self.now_ns = EPOCH_NS + now * PERIOD_NS
        self.clock.check()
        names = ["tick", "code", "subject", "value", "since"]
        return [row.tolist() for row in self._ring.read_new_rows().rows[names]]


@pytest.fixture
def watched(make_bus: MakeBus, monkeypatch: pytest.MonkeyPatch) -> Silence:
    return Silence(make_bus(), monkeypatch)


def test_a_task_waits_until_the_clock_is_checked_then_two_ticks_each_time(watched: Silence) -> None:
    due = EPOCH_NS + (10 + CLOCK_PATIENCE_TICKS) * PERIOD_NS
    patience = []
    for early in (PERIOD_NS, 1, 0, -1):
        watched.now_ns = due - early
        patience.append(watched.clock.compute_patience_ns(10))
    assert patience == [PERIOD_NS, 1, 2 * PERIOD_NS, 2 * PERIOD_NS]


@pytest.mark.parametrize("state", [*"TtZX"])
def test_a_stopped_or_dead_clock_is_reported_two_ticks_later(watched: Silence, state: str) -> None:
    watched.state = state
    watched.tick(7)
    assert watched.check(8) == []
    assert watched.check(9) == [(9, Alarm.CLOCK_STOPPED, CLOCK_PID, 2.0, 7)]


def test_a_silence_is_reported_once_and_the_next_one_again(watched: Silence) -> None:
    watched.state = "T"
    watched.tick(7)
    assert [len(watched.check(now)) for now in (9, 10, 40)] == [1, 0, 0]
    watched.tick(40)
    watched.clock.is_reported = False
    assert [len(watched.check(now)) for now in (42, 43)] == [1, 0]
    # The clock has caught up, as a check sees it.
    watched.tick(43)
    assert [len(watched.check(now)) for now in (43, 45, 46)] == [0, 1, 0]


def test_a_clock_that_could_run_is_only_late(watched: Silence) -> None:
    watched.tick(7)
    assert [watched.check(now) for now in (9, 8 + LONG, 10 + 9 * LONG)] == [[]] * 3


@pytest.mark.parametrize("newest", [0, 1, 2, 7])
def test_a_clock_that_waits_for_too_long_is_reported_at_the_second_check(
    watched: Silence, newest: int
) -> None:
    watched.state = "S"
    watched.tick(newest)
    looks = [newest + 2, newest + LONG, newest + LONG, newest + LONG + 1]
    assert [watched.check(now) for now in looks] == [[]] * 4
    assert len(watched.check(newest + LONG + 1)) == 1


def test_a_tick_or_a_check_that_finds_the_clock_runnable_ends_a_silence(watched: Silence) -> None:
    watched.tick(1)
    alarms = []
    for tick, state in ((1, "S"), (2, "S"), (2, "R"), (2, "S"), (2, "S")):
        watched.tick(tick)
        watched.state = state
        alarms.append(len(watched.check(10 + LONG)))
    assert alarms == [0, 0, 0, 0, 1]


def test_a_later_tick_or_the_end_of_the_run_disproves_a_stop(watched: Silence) -> None:
    watched.state = "T"
    watched.tick(7)
    watched.while_asked = lambda: watched.tick(12)
    assert watched.check(12) == []
    watched.while_asked = lambda: None
    watched.words[System.STATE] = Run.STOPPED
    assert watched.check(20) == []
    watched.words[System.STATE] = Run.RUNNING
    assert len(watched.check(20)) == 1
