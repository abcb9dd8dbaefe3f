"""Every kind of fault, for however long, ends: all goes on within the kind's bound, or what failed
is latched."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rack.backplane.address_map import CLOCK
from rack.backplane.fault_table import FaultTable, Stage
from rack.backplane.message import State
from rack.backplane.trace import open_trace_ring
from rack.backplane.words import Block
from rack.boards import Rack
from rack.boards.config.injections import build_injections
from rack.boards.errors import LaunchError
from rack.boards.faults.bounds import cycle_ticks
from rack.boards.faults.kind import KINDS, Kind
from tests.boards.conftest import MakeConfig
from tests.boards.fault_racks import FOLLOWED, LOCKED, OF_KINDS, PATIENCE_TICKS, TARGETS
from tests.boards.runs import faulty
from tests.processes import BOUND_S, wait_until

pytestmark = pytest.mark.thorough

FIRST = 104
LENGTHS: dict[str, dict[str, Any]] = {
    "one cycle": {"cycles": 1},
    "beyond patience": {"for": 1.0},
}
OTHERS = [kind for kind in KINDS if kind.where != "arm"]
"""Kinds that strike something else than the arm: for the arm's see test_servo_patience."""


def cases(realtime: bool) -> list[Any]:
    """Return every kind that needs real time, or that does not, with every length that it can
    have."""
    return [
        pytest.param(kind, length, id=f"{kind.name}, {name}")
        for kind in OTHERS
        if kind.where != "start" and kind.realtime is realtime
        for name, length in ({"once": {}} if kind.once else LENGTHS).items()
    ]


def rack_with(config: MakeConfig, kind: Kind, length: dict[str, Any]) -> Rack:
    """Return a rack whose wave, or what else the kind strikes, has the fault."""
    board = TARGETS.get(kind.name, TARGETS.get(kind.where, "wave"))
    settings = ["clock.mode=realtime"] if kind.realtime else []
    found = config(*settings, *OF_KINDS.get(kind.where, ()), text=FOLLOWED)
    tick = {} if kind.where == "start" else {"tick": FIRST}
    return Rack(faulty(found, {"kind": kind.name, "board": board, **tick, **length}))


@pytest.mark.parametrize(("kind", "length"), cases(realtime=False))
def test_a_fault_is_detected_and_ends_or_latches_within_its_bound(
    config: MakeConfig, kind: Kind, length: dict[str, Any]
) -> None:
    with rack_with(config, kind, length) as rack:
        layout = rack.segment.layout
        outcome = rack.run(3.0)
        (entry,) = FaultTable(rack.segment).list_entries((Stage.ACTIVE, Stage.OVER))
        board = layout.tasks[entry.task].name if entry.task >= 0 else CLOCK
        rows = open_trace_ring(rack.segment, "watch").read_new_rows().rows
    bound = kind.compute_bound_ticks(
        build_injections(rack.config, layout)[0], layout, "watch" if kind.takes_mailbox else None
    )
    found = min((event.tick for event in rack.events if event.code in kind.codes), default=None)
    if found is None:
        # One cycle may be too short to tell anything, or to hit a message.
        assert length == LENGTHS["one cycle"]
        found = FIRST
    assert bound is not None
    assert found - max(FIRST, entry.struck_tick) <= bound
    if outcome.state == "error":
        latched = int(rows["tick"][rows["state"] == State.ERROR][0])
        assert not outcome.is_success
        assert outcome.reason.startswith("nothing heard of the wave for")
        assert latched <= found + bound + PATIENCE_TICKS + cycle_ticks(layout, "watch")
        return
    assert outcome.is_success
    restart_s = rack.config.supervision.lockstep_restart_s
    over = max(entry.until if entry.stage == Stage.OVER else 0, found)
    if kind.consequence.ends_process and not kind.once:
        over = found
    after = rows[rows["tick"] >= over + kind.compute_recovery_ticks(board, layout, restart_s)]
    assert len(after) > 20
    assert np.all(after["state"] == State.EXECUTING)


@pytest.mark.parametrize(("kind", "length"), cases(realtime=True))
def test_a_fault_in_real_time_finally_ends_or_latches(
    config: MakeConfig, kind: Kind, length: dict[str, Any]
) -> None:
    with rack_with(config, kind, length) as rack:
        rack.start()
        entry, watch = FaultTable(rack.segment).entries[0], rack.segment.get_block("watch")
        tasks = [rack.segment.get_block(task.name) for task in rack.segment.layout.tasks]

        def is_over() -> bool:
            return entry.stage == Stage.OVER and not any(task[Block.LOST] for task in tasks)

        wait_until(lambda: not rack.watch(0.02) or is_over(), BOUND_S)
        before = [task[Block.CYCLES] for task in tasks]

        def goes_on() -> bool:
            cycled = all(task[Block.CYCLES] > n for task, n in zip(tasks, before, strict=True))
            return cycled and watch[Block.LEVEL_STATE] == State.EXECUTING

        wait_until(lambda: not rack.watch(0.02) or goes_on(), BOUND_S)
        if rack.outcome is not None:
            assert rack.outcome.reason.startswith("nothing heard of the wave for")
        elif kind.where in ("clock", "lock"):
            # A task that has lost its core to others may take none of the cycles of its fault.
            assert entry.count > 0


def test_a_lock_is_held_by_a_slow_task_in_its_next_cycle(config: MakeConfig) -> None:
    fault = {"kind": "lock-held", "board": "watch", "tick": FIRST + 1}
    with Rack(faulty(config("clock.mode=realtime", LOCKED, text=FOLLOWED), fault)) as rack:
        rack.start()
        entry = FaultTable(rack.segment).entries[0]
        wait_until(lambda: not rack.watch(0.02) or entry.stage == Stage.OVER)
        assert entry.struck_tick > FIRST + 1
        assert rack.watch(0.02)


@pytest.mark.parametrize("kind", [kind for kind in OTHERS if kind.where == "start"])
def test_a_rack_whose_start_fails_does_not_arm(config: MakeConfig, kind: Kind) -> None:
    with pytest.raises(LaunchError, match="wave"), rack_with(config, kind, {}):
        pass
