"""Bounds of detection, in ticks of a rack with a fast writer, its planner and a slow reader."""

from __future__ import annotations

from typing import Any

import pytest

from rack.boards.config import resolve_layout
from rack.boards.config.injections import build_injections
from rack.boards.faults.kind import KINDS
from tests.boards.conftest import MakeConfig
from tests.boards.fault_racks import rack

# The wave: every tick, read by its planner (a slice of four ticks) and by the watch (eight ticks).
CASES: dict[str, tuple[dict[str, Any], str | None, int | None]] = {
    "death, at the Rack": ({"kind": "kill", "board": "wave"}, None, 2),
    "death, at a neighbour": ({"kind": "kill", "board": "wave"}, "watch", 4 + 8),
    "slow task": ({"kind": "hang", "board": "watch"}, None, 5 * 8),
    "planner": ({"kind": "hang", "board": "wave.planner"}, None, 5 * 4),
    "overrun": ({"kind": "overrun", "board": "watch"}, None, 8),
    "mute, first reader": ({"kind": "mute", "board": "wave"}, None, 2 + 4),
    "mute, one reader": ({"kind": "mute", "board": "wave"}, "watch", 2 + 8),
    "mute, nobody reads": ({"kind": "mute", "board": "driven"}, None, None),
    "drop": ({"kind": "drop", "board": "wave"}, "watch", 1 + 1 + 8),
    "delay": ({"kind": "delay", "board": "wave", "by": 3}, "watch", 3 + 1 + 8),
    "corrupt": ({"kind": "corrupt", "board": "wave"}, "watch", 1 + 8),
    # It is visible after its slice.
    "corrupt plan": ({"kind": "corrupt", "board": "wave.planner"}, "wave", 4 + 1),
    "clock stops": ({"kind": "clock-stop", "board": "clock"}, None, 3),
    "clock skips": ({"kind": "clock-skip", "board": "clock", "ticks": 4}, None, 4),
    # The driven board has a cycle of two ticks.
    "sensor-stuck": ({"kind": "sensor-stuck", "board": "driven"}, None, 40),
    "actuator-off": ({"kind": "actuator-off", "board": "driven"}, None, 10),
    "command-nan": ({"kind": "command-nan", "board": "driven"}, None, 0),
    "by its size": ({"kind": "sensor-bias", "board": "driven"}, None, None),
    "at the start": ({"kind": "self-test", "board": "wave"}, None, None),
}


def bound(
    config: MakeConfig, fault: dict[str, Any], reader: str | None, *settings: str
) -> int | None:
    found = rack(config, fault, settings=settings)
    layout = resolve_layout(found)
    (injection,) = build_injections(found, layout)
    return KINDS[fault["kind"]].compute_bound_ticks(injection, layout, reader)


@pytest.mark.parametrize(("fault", "reader", "ticks"), CASES.values(), ids=CASES)
def test_a_fault_must_be_detected_within(
    config: MakeConfig, fault: dict[str, Any], reader: str | None, ticks: int | None
) -> None:
    assert bound(config, fault, reader) == ticks


def test_a_slow_planner_is_detected_after_its_slice_and_one_release(config: MakeConfig) -> None:
    # Half as fast: a slice of four cycles of two ticks, and one such cycle.
    fault = {"kind": "planner-slow", "board": "wave.planner"}
    assert bound(config, fault, None, "board.wave.rate_hz=200") == 4 * 2 + 2


def test_a_held_lock_is_detected_within_the_bound_of_a_wait(config: MakeConfig) -> None:
    # 2 ms of 2.5 ms ticks, and the cycle of the first reader.
    fault = {"kind": "lock-held", "board": "wave"}
    assert bound(config, fault, None, "protocol.default=lock") == 1 + 4
