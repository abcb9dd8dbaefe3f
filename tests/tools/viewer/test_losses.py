"""A lost board in the viewer: red until it returns, and so is the arm while it is silent."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from rack.tools.viewer.reading import EntityRows, read_component
from rack.tools.viewer.style import LOST
from tests.shared_runs import run_text

pytestmark = pytest.mark.slow

LOST_AT = (200, 600)
"""Ticks at which the servo board is killed and hangs."""
STATE = "StateChange:state"
LOSSES = """
format = 2
extends = ["nasrem"]
fault = [
    { kind = "kill", board = "servo", at = 0.5 },
    { kind = "hang", board = "servo", at = 1.5 },
    { kind = "kill", board = "world", at = 0.5 },
]
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_text(tmp_path_factory, LOSSES, 2.8, "clock.mode=lockstep") / "run.rrd"


def list_spans(rows: EntityRows, states: Iterable[str]) -> list[tuple[int, int]]:
    """Return the first tick of each span in one of these states, and of the span after it."""
    ticks = rows.ticks.tolist()
    values = rows.values.ravel().tolist()
    return [
        (ticks[index], ticks[index + 1])
        for index, state in enumerate(values)
        if state in states and values[index - 1] not in states
    ]


@pytest.mark.thorough
def test_a_dead_and_a_hanging_board_are_lost_until_they_return(file: Path) -> None:
    events = read_component(file, "/log/events", "TextLog:text").values.ravel().tolist()
    returns = [int(line.split()[1].rstrip(":")) for line in events if "'servo' rejoined" in line]
    spans = list(zip(LOST_AT, returns, strict=True))
    assert all(until - since >= 100 for since, until in spans)
    for lane in ("/levels/4-servo/state", "/boards/4-servo/executor"):
        assert list_spans(read_component(file, lane, STATE), ["lost"]) == spans
    other = read_component(file, "/boards/4-servo/planner", STATE)
    assert "lost" not in other.values.ravel().tolist()
    (world,) = list_spans(read_component(file, "/boards/5-world/executor", STATE), ["lost"])
    assert world[0] == LOST_AT[0]


def test_the_arm_is_red_while_its_board_is_silent(file: Path) -> None:
    rows = read_component(file, "/cell/link3/forearm", "Capsules3D:colors")
    silence = read_component(file, "/levels/4-servo/state", STATE)
    for since, until in list_spans(silence, ["lost"]):
        for tick, is_red in ((since - 1, False), (since, True), (until - 1, True)):
            newest = np.flatnonzero(rows.ticks <= tick)[-1]
            assert (int(rows.values.ravel()[newest]) == LOST) is is_red, tick
    assert rows.values.ravel()[-1] != LOST


def test_every_line_of_the_log_begins_with_its_tick(file: Path) -> None:
    for source in ("events", "levels"):
        try:
            rows = read_component(file, f"/log/{source}", "TextLog:text")
        except KeyError:
            continue
        for tick, line in zip(rows.ticks, rows.values.ravel(), strict=True):
            assert line.startswith(f"tick {tick}: "), line
