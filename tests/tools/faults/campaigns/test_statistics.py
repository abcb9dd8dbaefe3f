"""The figures of a campaign, from hand-made judgements."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from rack.tools.faults.campaigns.statistics import (
    EventRate,
    Spread,
    compute_by_kind,
    compute_rate,
    compute_wilson_interval,
    count_faults,
    list_size_points,
)
from rack.tools.faults.ending import EXTERNAL
from rack.tools.faults.judge import Judgement
from tests.tools.fault_events import TICK_NS


def judgement(kind: str = "mute", delay: int | None = 5, bound: int = 10, **more: Any) -> Judgement:
    found = Judgement(
        kind=kind,
        board="lower",
        mailbox="",
        joint="",
        size=None,
        began=90,
        struck=100,
        seen="missed" if delay is None else "detected",
        is_judged=True,
        cycle=2,
        delay=delay,
        delay_ms=None if delay is None else delay * 2.5,
        bound=bound,
        is_within=delay is not None and delay <= bound,
    )
    return replace(found, **more)


def test_faults_that_did_not_act_count_only_as_drawn() -> None:
    faults = [judgement(), judgement(delay=12), judgement(delay=None)]
    faults.append(judgement(seen="not struck", struck=-1))
    found = count_faults(faults)
    assert (found.drawn, found.not_struck, found.injected) == (4, 1, 3)
    assert (found.detected, found.missed) == (2, 1)
    assert (found.within_bound, found.recovered) == (1, 3)


def test_cycles_are_of_the_task_concerned_and_parts_of_each_bound() -> None:
    faults = [judgement(delay=2), judgement(delay=4), judgement(delay=12, cycle=12, bound=12)]
    figures = compute_by_kind(faults, TICK_NS)["mute"]
    assert figures.ticks == Spread(4, 12)
    assert figures.cycles == Spread(1.0, 2.0)
    assert figures.part_of_bound == Spread(0.4, 1.0)
    assert figures.bound_ticks == {"least": 10, "most": 12}


def test_kinds_are_in_order_and_kills_from_outside_are_last() -> None:
    faults = [judgement(EXTERNAL), judgement("command-nan"), judgement("kill"), judgement("mute")]
    assert list(compute_by_kind(faults, TICK_NS)) == ["kill", "mute", "command-nan", EXTERNAL]


def test_a_death_is_measured_in_time_where_time_is_its_bound() -> None:
    assert judgement(delay=1, bound=2, delay_ms=4.0, bound_ms=5.0).fraction_of_bound == 0.8
    assert judgement(delay=1, bound=2, delay_ms=4.0).fraction_of_bound == 0.5
    assert judgement(delay=0, bound=0, delay_ms=0.0).fraction_of_bound is None
    assert judgement(delay=None, bound=2).fraction_of_bound is None


def test_the_bounds_of_a_share_follow_wilson() -> None:
    # As in any table of them.
    assert compute_wilson_interval(100, 100) == (0.963007, 1.0)
    assert compute_wilson_interval(5, 10) == (0.236593, 0.763407)
    assert compute_wilson_interval(0, 10) == (0.0, 0.277533)
    assert compute_wilson_interval(0, 0) is None


def test_a_rate_has_an_upper_bound_even_without_events() -> None:
    # Three in as much time as there was, with 95 %, is what none seen permits.
    assert compute_rate(0, 3600.0) == EventRate(0.0, 2.996)
    assert compute_rate(2, 7200.0) == EventRate(1.0, 3.148)
    assert compute_rate(0, 0.0) is None


def test_a_curve_is_sorted_by_size_and_includes_undetected_faults() -> None:
    sized = judgement("sensor-bias", size=0.1)
    faults = [sized, judgement("sensor-bias", size=0.001, delay=None), judgement()]
    points = list_size_points(faults, "sensor-bias", TICK_NS)
    assert [(point.size, point.delay_ms) for point in points] == [(0.001, None), (0.1, 12.5)]
