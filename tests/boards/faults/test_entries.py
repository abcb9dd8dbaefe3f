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


KILL = {"kind": "kill", "board": "wave"}
MUTE = {"kind": "mute", "board": "wave"}
TIMES: list[tuple[dict[str, Any], str, int]] = [
    (KILL, "tick", -1),
    ({**KILL, "tick": 40}, "tick", 40),
    ({**KILL, "tick": 0}, "tick", 0),
    # The nearest tick.
    ({**KILL, "at": 0.1}, "tick", 40),
    ({**KILL, "at": 0.1012}, "tick", 40),
    ({**KILL, "at": 0.1013}, "tick", 41),
    # Rounded down to thousandths of a tick.
    ({**KILL, "phase": 0.2505}, "phase", 250),
    (MUTE, "ticks", 0),
    ({**MUTE, "for": "50ms"}, "ticks", 20),
    ({**MUTE, "for": "1ms"}, "ticks", 1),
    ({**MUTE, "cycles": 3}, "ticks", 3),
    ({**MUTE, "board": "watch", "cycles": 3}, "ticks", 24),
    # A plan takes four cycles of its planner.
    ({**MUTE, "board": "wave.planner", "cycles": 3}, "ticks", 12),
]
"""Faults, and an attribute of their entries with its value."""


@pytest.mark.parametrize(("fault", "name", "value"), TIMES)
def test_begin_phase_and_length_of_a_fault_are_in_ticks(
    config: MakeConfig, fault: dict[str, Any], name: str, value: int
) -> None:
    (found,) = injected(config, fault)
    assert getattr(found, name) == value


@pytest.mark.parametrize("value", ["done", "DONE", str(int(State.DONE))])
def test_a_condition_compares_with_a_number_or_its_name(config: MakeConfig, value: str) -> None:
    when = f"watch.status.state=={value}"
    (found,) = injected(config, {**KILL, "when": when})
    assert found.when is not None
    at, field, number = found.when
    box = resolve_layout(rack(config)).mailboxes[at]
    assert (box.name, box.fields[field].name, number) == ("watch.status", "state", State.DONE)


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
