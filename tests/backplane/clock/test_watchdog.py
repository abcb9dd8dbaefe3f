"""The watchdog: a missed release is only a miss; a loss needs proof."""

from __future__ import annotations

import os
import signal
import time

import pytest

from rack.backplane.clock.released_task import MIN_HANG_NS, RELEASES_MISSED, ReleasedTask, Watchdog
from rack.backplane.process import busy_wait_until, read_state
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter, open_alarm_ring
from rack.backplane.words import Block, TaskState
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, forked, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)
PERIOD_NS = 2_500_000


class Watched:
    """A task played by the test, and the watchdog's alarms."""

    def __init__(self, segment: Segment, pid: int) -> None:
        self.task = ReleasedTask(segment, segment.layout.find_task("writer"))
        self.task.block[Block.PID] = pid
        self.task.block[Block.STATE] = TaskState.RUNNING
        self.watchdog = Watchdog(AlarmWriter(segment, "clock"), PERIOD_NS)
        self._ring = open_alarm_ring(segment, "clock")
        self.tick = -1

    def release(self, answered: bool) -> list[Alarm]:
        """Release the task for the next tick; return the alarms raised."""
        self.tick += 1
        if answered:
            self.task.block[Block.DONE] = self.task.block[Block.RELEASED]
        self.task.release(self.tick)
        if self.task.missed:
            self.watchdog.check(self.task, self.tick)
        return [Alarm(code) for code in self._ring.read_new_rows().rows["code"]]


def test_a_late_cycle_counts_as_one_miss(make_bus: MakeBus) -> None:
    watched = Watched(make_bus(), os.getpid())
    watched.release(True)
    assert [watched.release(True) for _ in range(5)] == [[]] * 5
    rung = [watched.release(answered) for answered in (False, False, True, True, False)]
    assert rung == [[Alarm.LATE], [], [], [], [Alarm.LATE]]


def test_a_process_that_could_run_is_starved_and_not_lost(make_bus: MakeBus) -> None:
    watched = Watched(make_bus(), os.getpid())
    watched.release(True)
    rung = [watched.release(False) for _ in range(3 * RELEASES_MISSED)]
    assert [alarms for alarms in rung if alarms] == [[Alarm.LATE], [Alarm.STARVED]]
    assert rung[RELEASES_MISSED - 1] == [Alarm.STARVED]
    assert (watched.watchdog.losses, watched.task.lost_tick) == (0, -1)


def silent(watched: Watched) -> list[Alarm]:
    """Release a task for longer than any may be silent; return the alarms of the next release."""
    watched.release(True)
    assert not any(Alarm.HANG in watched.release(False) for _ in range(MIN_HANG_NS // PERIOD_NS))
    return watched.release(False)


def test_a_process_that_waits_for_something_else_is_lost_in_the_end(make_bus: MakeBus) -> None:
    segment = make_bus()
    with forked(lambda: time.sleep(60)) as pid:
        wait_until(lambda: read_state(pid) == "S")
        watched = Watched(segment, pid)
        assert silent(watched) == [Alarm.HANG]
    assert watched.task.lost_tick == watched.tick


def test_a_process_that_gets_no_processor_time_is_never_lost(make_bus: MakeBus) -> None:
    # This process runs, and its releases go by faster than it could use the time.
    assert silent(Watched(make_bus(), os.getpid())) == []


def test_a_process_that_computes_and_never_ends_its_cycle_is_lost_in_the_end(
    make_bus: MakeBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "rack.backplane.clock.released_task.MIN_HANG_NS", 4 * RELEASES_MISSED * PERIOD_NS
    )
    watched = Watched(make_bus(), os.getpid())
    watched.release(True)
    rung = [watched.release(False) for _ in range(5 * RELEASES_MISSED)]
    assert not any(Alarm.HANG in alarms for alarms in rung)
    busy_wait_until(time.process_time_ns() + 100_000_000)
    assert watched.release(False) == [Alarm.HANG]


def test_a_stopped_process_is_lost_after_four_releases(make_bus: MakeBus) -> None:
    segment = make_bus()
    with forked(lambda: time.sleep(60)) as pid:
        watched = Watched(segment, pid)
        watched.release(True)
        os.kill(pid, signal.SIGSTOP)
        wait_until(lambda: read_state(pid) == "T")
        rung = [watched.release(False) for _ in range(RELEASES_MISSED)]
    assert rung == [[Alarm.LATE], [], [], [Alarm.HANG]]
    assert watched.watchdog.losses == 1
    assert not watched.task.can_take_release(watched.tick + 1)


def test_a_task_that_finishes_every_cycle_too_late_is_late_and_not_lost(make_bus: MakeBus) -> None:
    watched = Watched(make_bus(), os.getpid())
    watched.release(True)
    rung = []
    for tick in range(1, 20 * MIN_HANG_NS // PERIOD_NS):
        rung += watched.release(False)
        # It finishes the release before this one meanwhile.
        watched.task.block[Block.DONE] = tick - 1
    assert rung == [Alarm.LATE]
    assert watched.watchdog.losses == 0
