"""Configs of cells: mailboxes made for the arms, and one line for each mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.boards import Rack
from rack.boards.config import load
from tests.boards.config.mistakes import find_mistake

RACK = """
extends = ["cell"]
[board.task.params]
arms = { puma = "lan.puma", k1607 = "lan.k1607" }
[[task.step]]
do = [
    { arm = "puma", do = "home", by = 20.0 },
    { arm = "k1607", do = "goto", position = [0.8, 0.5, 0.2], by = 15.0 },
]
[[task.step]]
do = [{ arm = "puma", do = "home", by = 30.0 }]
"""


ARMS, SECOND, LAST = "board.task.params.arms", "task.step[0].do[1]", "task.step[1].do"
HOME, LONG = 'do = "home", by = 30.0', "a part whose name is longer than 32"
TRANSFER = f'do = "transfer", object = "{LONG}", to = [0, 0, 0]'
TWICE, EARLIER = "this arm already has an action in this step", "the time of an earlier step"
TOO_LONG = "an order can contain at most 32 ASCII characters"


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            'arm = "k1607"',
            'arm = "ur5"',
            f"{ARMS} = \"puma, k1607\": lacks 'ur5', the arm of {SECOND}",
        ),
        ('arm = "k1607"', 'arm = "puma"', f'{SECOND}.arm = "puma": {TWICE}'),
        ("by = 30.0", "by = 20.0", f"{LAST}[0].by = 20.0: must be later than 20, {EARLIER}"),
        (
            f'[{{ arm = "puma", {HOME} }}]',
            "[]",
            f"{LAST} = []: a step must have at least one action",
        ),
        (HOME, 'do = "fly"', f'{LAST}[0].do = "fly": valid values: transfer, goto, home'),
        ('arm = "k1607", ', "", f"{SECOND}.arm: missing; arm that does it"),
        ("lan.k1607", "lan.other", "lan.other"),
        (HOME, TRANSFER, f'{LAST}[0].object = "{LONG}": {TOO_LONG}'),
    ],
)
def test_each_mistake_is_one_line(tmp_path: Path, old: str, new: str, line: str) -> None:
    assert old in RACK
    (tmp_path / "own.toml").write_text(RACK.replace(old, new))
    assert line in find_mistake(tmp_path / "own.toml")


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


@pytest.mark.thorough
def test_order_is_done_in_time_whichever_board_is_killed(rack_name: str) -> None:
    config = load("nasrem", [f"name={rack_name}", *ORDERED])
    with Rack(config.model_copy(update={"task": {"step": [{"do": [REACH]}]}})) as rack:
        outcome = rack.run()
    assert (outcome.cause, outcome.faults) == ("task done", ())
    assert outcome.ticks * 2.5e-3 < BY + 2.0
