"""The clock guard: reports by cycle, and its state after a restart."""

from __future__ import annotations

import time

import pytest

from rack.backplane.clock.driver import RealtimeDriver
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter, open_alarm_ring
from rack.backplane.words import System
from rack.boards.run.task import ClockGuard
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus

PERIOD_NS = 20_000_000


def guard_of(segment: Segment) -> ClockGuard:
    """Return the guard of the task "level", as its process makes it."""
    return ClockGuard(segment, AlarmWriter(segment, "level"), segment.get_block("level"))


def rung(segment: Segment) -> list[tuple[int, int, float]]:
    """Return tick, first tick skipped and count of each skip reported since the last call."""
    rows, _ = open_alarm_ring(segment, "level").read_new_rows()
    assert {int(row["code"]) for row in rows} <= {Alarm.CLOCK_SKIPPED}
    return [(int(row["tick"]), int(row["since"]), float(row["value"])) for row in rows]


def test_a_skip_is_reported_in_the_first_cycle_released_after_it(make_bus: MakeBus) -> None:
    segment = make_bus(task("level", every=4))
    guard, driver = guard_of(segment), RealtimeDriver(segment, lambda _: None)
    driver.count_skipped(5, 2)
    # Released at tick 4, begun when the clock had skipped ticks already.
    guard.report_skipped(4)
    assert guard.reported == 0
    guard.report_skipped(8)
    assert rung(segment) == [(8, 5, 2.0)]
    assert guard.reported == segment.words[System.CLOCK_SKIPPED] == 2
    # From the very tick of a release it is reported in it.
    driver.count_skipped(12, 2)
    guard.report_skipped(12)
    assert rung(segment)[1:] == [(12, 12, 2.0)]


def test_a_restarted_guard_reports_what_was_skipped_while_it_was_away(make_bus: MakeBus) -> None:
    segment = make_bus(task("level", every=4))
    guard, driver = guard_of(segment), RealtimeDriver(segment, lambda _: None)
    driver.count_skipped(1, 1)
    guard.report_skipped(4)
    driver.count_skipped(9, 3)
    guard_of(segment).report_skipped(16)
    assert guard_of(segment).reported == 4
    assert rung(segment)[1:] == [(16, 9, 3.0)]


def test_ticks_that_a_late_clock_skips_are_reported_with_the_first_of_them(
    make_bus: MakeBus,
) -> None:
    segment = make_bus(task("level"))
    segment.words[System.PERIOD_NS] = PERIOD_NS
    segment.words[System.EPOCH_NS] = time.monotonic_ns() + PERIOD_NS
    guard, held_up = guard_of(segment), []

    def ended(tick: int) -> int | None:
        if segment.words[System.CLOCK_SKIPPED] != guard.reported:
            guard.report_skipped(tick)
        if tick >= 3 and not held_up:
            held_up.append(tick)
            time.sleep(3.5 * PERIOD_NS * 1e-9)
        return 12 if tick >= 12 else None

    RealtimeDriver(segment, ended).run()
    skips = rung(segment)
    assert held_up[0] + 1 in [first for _, first, _ in skips]
    # From the first one skipped up to the tick that follows.
    assert all(count == tick - first for tick, first, count in skips)
    assert sum(count for _, _, count in skips) == segment.words[System.CLOCK_SKIPPED] >= 2


@pytest.mark.parametrize(("part", "count"), [(0.4, 0), (0.6, 1)])
def test_a_clock_is_late_from_half_a_tick_on(part: float, count: int, make_bus: MakeBus) -> None:
    segment = make_bus(task("level", every=4))
    segment.words[System.PERIOD_NS] = PERIOD_NS
    guard = guard_of(segment)
    segment.words[System.TICK] = 4
    segment.words[System.TICK_NS] = 4 * PERIOD_NS + round(part * PERIOD_NS)
    guard.check_release(4, 0)
    guard.check_release(4, 0)
    rows, _ = open_alarm_ring(segment, "level").read_new_rows()
    assert [int(row["code"]) for row in rows] == [Alarm.CLOCK_LATE] * count
