"""The level of the paper's figures 2 to 4 consumes the given processor times."""

from __future__ import annotations

from time import process_time_ns
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.levels.errors import LevelError
from rack.levels.level import LevelContext
from rack.levels.systems.figures import FigureExecutor, FigurePlanner, FigureStatus

MS = 1_000_000


def context(**params: Any) -> LevelContext:
    return cast(LevelContext, SimpleNamespace(every=4, params=params, sizes={}))


def computing_ns(executor: FigureExecutor, tick: int) -> int:
    """Return the processor time of one cycle."""
    start = process_time_ns()
    executor.process(tick)
    return process_time_ns() - start


def test_an_executor_computes_for_its_time_in_every_cycle() -> None:
    executor = FigureExecutor(context(process_ms=3.0))
    times = [computing_ns(executor, tick) for tick in (0, 4, 8)]
    assert all(time >= 3 * MS for time in times)
    assert min(times) < 4 * MS
    # Several times are repeated in order.
    executor = FigureExecutor(context(process_ms=[6.0, 1.0]))
    # A skipped cycle also skips its time.
    long = [computing_ns(executor, tick) >= 6 * MS for tick in (0, 4, 12, 16)]
    assert long == [True, False, False, True]


def test_a_planner_computes_for_its_time_and_always_wants_a_plan() -> None:
    planner, status = FigurePlanner(context(plan_ms=4.0)), FigureStatus.zeros({})
    status.cycle = 8
    assert planner.wanted(0)
    vars(planner).update(status=Reading(status, Verdict.NEW))
    start = process_time_ns()
    planner.plan(16)
    assert process_time_ns() - start >= 4 * MS
    assert (planner.output.made_at, planner.output.cycle) == (16, 8)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"process_ms": -1.0}, "params.process_ms"),
        ({"process_ms": []}, "params.process_ms"),
        ({"plan_ms": "long"}, "params.plan_ms = 'long'"),
        ({"proces_ms": 1.0}, "keys: process_ms, plan_ms"),
    ],
)
def test_an_invalid_time_is_refused_by_its_key(params: dict[str, Any], message: str) -> None:
    with pytest.raises(LevelError, match=message):
        FigureExecutor(context(**params))
