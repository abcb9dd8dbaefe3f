"""The system clock as read by boards, and the rates that its grid permits."""

from __future__ import annotations

import re
import time

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rack.backplane.clock.system_clock import SystemClock, compute_period_ticks, format_rate
from rack.backplane.errors import ClockError
from rack.backplane.words import Run, System
from tests.backplane.conftest import MakeBus

CLOCK_NS = 2_500_000


@pytest.mark.parametrize(
    ("rate_hz", "ticks"), [(400, 1), (50, 8), (4, 100), (1, 400), (400 / 3, 3), (0.1, 4000)]
)
def test_a_rate_on_the_grid_is_a_number_of_ticks(rate_hz: float, ticks: int) -> None:
    assert compute_period_ticks(rate_hz, CLOCK_NS, "level") == ticks


def test_a_rate_off_the_grid_is_refused_with_its_neighbours() -> None:
    with pytest.raises(ClockError) as error:
        compute_period_ticks(60, CLOCK_NS, "level 'primitive'")
    assert str(error.value) == (
        "level 'primitive': 60 Hz does not divide the 400 Hz clock; "
        "nearest: 57.14 Hz (every 7 ticks), 66.67 Hz (every 6 ticks)"
    )
    with pytest.raises(ClockError, match=r"nearest: 400 Hz \(every 1 tick\)$"):
        compute_period_ticks(401, CLOCK_NS, "level")
    with pytest.raises(ClockError, match=r"nearest: 30 Hz \(every 2 ticks\)$"):
        compute_period_ticks(45, 1_000_000_000 // 60, "exchange", fastest_hz=50.0)


@given(clock_ns=st.integers(10_000, 10**9), rate_hz=st.floats(1e-6, 1e9))
@example(clock_ns=1_000_000, rate_hz=333.0)
@example(clock_ns=1_000_000, rate_hz=0.3)
@example(clock_ns=2_500_000, rate_hz=60.0)
@example(clock_ns=1_000_000, rate_hz=3.91)
@example(clock_ns=333_333, rate_hz=0.19998)
def test_every_rate_that_a_refusal_suggests_is_accepted_as_typed(
    clock_ns: int, rate_hz: float
) -> None:
    try:
        compute_period_ticks(rate_hz, clock_ns, "level")
    except ClockError as error:
        hints = re.findall(r"(\S+) Hz \(every (\d+)", str(error))
        assert hints
        for rate, every in hints:
            found = compute_period_ticks(float(rate), clock_ns, "level")
            assert found == int(every) or format_rate(1e9 / clock_ns / found) == rate


@pytest.mark.parametrize("rate_hz", [333.3, 57.14, 3.906])
def test_a_rate_may_be_rounded_to_four_digits(rate_hz: float) -> None:
    clock_ns = {333.3: 1_000_000, 57.14: CLOCK_NS, 3.906: 1_000_000}[rate_hz]
    assert compute_period_ticks(rate_hz, clock_ns, "level") == round(1e9 / clock_ns / rate_hz)
    for changed in (rate_hz + 0.02, rate_hz - 0.02):
        with pytest.raises(ClockError, match="does not divide"):
            compute_period_ticks(changed, clock_ns, "level")


@pytest.mark.parametrize("rate_hz", [0.0, -50.0, float("nan"), 5e-324])
def test_an_impossible_rate_is_refused(rate_hz: float) -> None:
    with pytest.raises(ClockError, match="is not a rate"):
        compute_period_ticks(rate_hz, CLOCK_NS, "level")


def test_the_current_tick_follows_the_grid_in_real_time(make_bus: MakeBus) -> None:
    segment = make_bus()
    segment.words[System.EPOCH_NS], segment.words[System.PERIOD_NS] = 1_000, 2_500_000
    clock = SystemClock(segment)
    assert [clock.compute_time_ns(tick) for tick in (0, 1, 400)] == [
        1_000,
        2_501_000,
        1_000_001_000,
    ]
    period_ns = 1_000_000_000_000
    segment.words[System.PERIOD_NS] = period_ns
    segment.words[System.EPOCH_NS] = time.monotonic_ns() - 7 * period_ns - period_ns // 2
    clock = SystemClock(segment)
    assert (clock.compute_tick(), clock.tick) == (7, 0)


def test_the_clock_board_sets_the_current_tick_in_lockstep(make_bus: MakeBus) -> None:
    segment = make_bus()
    segment.words[System.LOCKSTEP], segment.words[System.TICK] = 1, 12
    clock, seen = SystemClock(segment), []
    assert (clock.compute_tick(), clock.tick) == (12, 12)
    for state in Run:
        segment.words[System.STATE] = state
        seen.append(clock.is_stopped)
    assert seen == [False, False, True]
