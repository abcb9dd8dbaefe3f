"""Bounds of detection, in ticks of a rack with a fast writer, its planner and a slow reader; and of
all faults that can strike the shipped racks: nothing of them changes unseen."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout
from rack.boards.config import load, resolve_layout
from rack.boards.config.injections import build_injections
from rack.boards.faults.bounds import compute_last_read_ticks, list_affected_mailboxes
from rack.boards.faults.kind import KINDS, Kind
from tests.boards.conftest import MakeConfig
from tests.boards.fault_racks import rack
from tests.snapshots import ROOT, Snapshots, each_shipped_rack

# The wave: every tick, read by its planner (a slice of four ticks) and by the watch (eight ticks).
CASES: dict[str, tuple[Any, ...]] = {
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
    # Half as fast: a slice of four cycles of two ticks, and one such cycle.
    "slow planner": (
        {"kind": "planner-slow", "board": "wave.planner"},
        None,
        4 * 2 + 2,
        "board.wave.rate_hz=200",
    ),
    # The bound of a wait, 2 ms of 2.5 ms ticks, and the cycle of the first reader.
    "held lock": ({"kind": "lock-held", "board": "wave"}, None, 1 + 4, "protocol.default=lock"),
}
"""Fault, reader, ticks until it must be detected, and settings."""


@pytest.mark.parametrize("case", CASES)
def test_a_fault_must_be_detected_within(config: MakeConfig, case: str) -> None:
    fault, reader, ticks, *settings = CASES[case]
    found = rack(config, fault, settings=tuple(settings))
    layout = resolve_layout(found)
    (injection,) = build_injections(found, layout)
    assert KINDS[fault["kind"]].compute_bound_ticks(injection, layout, reader) == ticks


SNAPSHOTS = Snapshots(__file__)
RESTARTS_S = (0.0, 0.25)


def injections(kind: Kind, layout: Layout) -> Iterator[Injection]:
    """Yield a fault of a kind for every task and for each mailbox that it writes."""
    parameters = tuple(float(p.default or 3.0) for p in kind.parameters)
    for task, process in enumerate(layout.processes):
        boxes = [at for at, box in enumerate(layout.mailboxes) if box.writer == process.name]
        for mailbox in (-1, *boxes):
            yield Injection(kind.number, task, mailbox, 0, 0, 0, 0, None, parameters)


@each_shipped_rack
def test_the_bounds_of_a_shipped_rack_are_as_before(name: str) -> None:
    layout = resolve_layout(load(ROOT / "configs" / name))
    parts: dict[str, object] = {}
    for kind in KINDS:
        if kind.where == "clock":
            parameters = (3.0,) * len(kind.parameters)
            clock = Injection(kind.number, -1, -1, 0, 0, 0, 0, None, parameters)
            parts[kind.name] = kind.compute_bound_ticks(clock, layout)
            continue
        found: list[object] = []
        for injection in injections(kind, layout):
            board = layout.processes[injection.task].name
            struck = list_affected_mailboxes(layout, injection.mailbox, board)
            readers = sorted({reader for box in struck for reader in box.readers})
            if kind.tasks and layout.find_task(board).role not in kind.tasks:
                continue
            if kind.takes_mailbox and not readers:
                continue
            for reader in (None, *readers):
                found.append(kind.compute_bound_ticks(injection, layout, reader))
            found += [kind.compute_recovery_ticks(board, layout, restart) for restart in RESTARTS_S]
        parts[kind.name] = found
    parts["last reads"] = [compute_last_read_ticks((box.name,), layout) for box in layout.mailboxes]
    SNAPSHOTS.check(name, {"bounds": parts})
