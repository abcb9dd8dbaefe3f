"""From faults of a config to entries of the fault table: ticks, indices, seeds."""

from __future__ import annotations

from typing import Any

import pytest

from rack.backplane.fault_table import Injection
from rack.backplane.message import State
from rack.boards.config import resolve_layout
from rack.boards.config.injections import build_injections
from tests.boards.conftest import MakeConfig
from tests.boards.fault_racks import rack


def injected(config: MakeConfig, *faults: dict[str, Any]) -> tuple[Injection, ...]:
    found = rack(config, *faults)
    return build_injections(found, resolve_layout(found))


@pytest.mark.parametrize(
    ("begin", "tick"),
    [
        ({}, -1),
        ({"tick": 40}, 40),
        ({"tick": 0}, 0),
        ({"at": 0.1}, 40),
        ({"at": 0.1012}, 40),
        ({"at": 0.1013}, 41),
    ],
)
def test_a_fault_begins_at_a_tick_or_at_the_tick_nearest_to_its_time(
    config: MakeConfig, begin: dict[str, Any], tick: int
) -> None:
    (found,) = injected(config, {"kind": "kill", "board": "wave", **begin})
    assert found.tick == tick


@pytest.mark.parametrize(
    ("board", "end", "ticks"),
    [
        ("wave", {}, 0),
        ("wave", {"for": "50ms"}, 20),
        ("wave", {"for": "1ms"}, 1),
        ("wave", {"cycles": 3}, 3),
        ("watch", {"cycles": 3}, 24),
        # A plan takes four cycles of its planner.
        ("wave.planner", {"cycles": 3}, 12),
    ],
)
def test_a_fault_lasts_for_a_time_or_for_cycles_of_its_task(
    config: MakeConfig, board: str, end: dict[str, Any], ticks: int
) -> None:
    (found,) = injected(config, {"kind": "mute", "board": board, **end})
    assert found.ticks == ticks


@pytest.mark.parametrize("value", ["done", "DONE", str(int(State.DONE))])
def test_a_condition_compares_with_a_number_or_its_name(config: MakeConfig, value: str) -> None:
    when = f"watch.status.state=={value}"
    (found,) = injected(config, {"kind": "kill", "board": "wave", "when": when})
    assert found.when is not None
    at, field, number = found.when
    box = resolve_layout(rack(config)).mailboxes[at]
    assert (box.name, box.fields[field].name, number) == ("watch.status", "state", State.DONE)


def test_a_phase_is_rounded_down_to_thousandths_of_a_tick(config: MakeConfig) -> None:
    (found,) = injected(config, {"kind": "kill", "board": "wave", "phase": 0.2505})
    assert found.phase == 250


def test_faults_draw_different_random_numbers_that_repeat_with_the_racks_seed(
    config: MakeConfig,
) -> None:
    drop = {"kind": "drop", "board": "wave"}
    first, second, given = injected(config, drop, drop, {**drop, "seed": 7})
    assert first.seed != second.seed
    assert given.seed == 7
    assert injected(config, drop, drop)[1].seed == second.seed
    other = rack(config, drop, settings=("seed=1",))
    assert build_injections(other, resolve_layout(other))[0].seed != first.seed
