"""A coordinator and the PUMA as boards of one rack: real processes, in lockstep."""

from __future__ import annotations

import pytest

from rack.boards import Rack
from rack.boards.config import load
from rack.boards.config.schema import RackConfig

pytestmark = pytest.mark.slow

ORDERED = (
    "clock.mode=lockstep",
    "board.task.rate_hz=4",
    "board.task.within_cycles=4",
    "board.task.executor=rack.levels.systems.coordination:OrderedTaskExecutor",
    "board.task.planner=rack.levels.systems.coordination:OrderedTaskPlanner",
    "board.task.params={orders='cell.order_puma', decision=2.0}",
    "board.task.ends_run=false",
    (
        "board.cell={slot=9, rate_hz=4, executor='rack.levels.systems.coordination:Coordinator',"
        " ends_run=true}"
    ),
    "board.cell.params={arms={puma='task.report'}}",
    "fault=[{kind='kill', board='cell', at=2.5}, {kind='kill', board='task', at=4.5}]",
)
BY = 9.0
REACH = {"arm": "puma", "do": "goto", "position": [0.45, 0.10, 0.95], "by": BY}


def one_rack(name: str) -> RackConfig:
    """Return the NASREM rack with a coordinator above its task level."""
    config = load("nasrem", [f"name={name}", *ORDERED])
    return config.model_copy(update={"task": {"step": [{"do": [REACH]}]}})


def test_order_is_done_in_time_by_the_boards_of_one_rack_whichever_is_killed(
    rack_name: str,
) -> None:
    with Rack(one_rack(rack_name)) as rack:
        outcome = rack.run()
    assert (outcome.cause, outcome.faults) == ("task done", ())
    assert outcome.ticks * 2.5e-3 < BY + 2.0
