"""Ticks that the clock skips in racks where no board runs in every tick: each skip is seen, however
short."""

from __future__ import annotations

import pytest

from rack.boards import Rack
from rack.boards.config import load, resolve
from rack.tools.faults.ending import list_strikes
from rack.tools.faults.judge import Circumstances, Judge

pytestmark = pytest.mark.thorough

FIRST, APART = 101, 41
"""First fault, and ticks from one to the next: odd, so that the skips begin in every phase of the
boards."""
LENGTHS = (1, 2, 3, 4) * 4
AFTER = 60
"""Ticks of the run after the last fault."""


@pytest.mark.parametrize("name", ["hic", "condor"])
@pytest.mark.timeout(120)
def test_a_skip_of_any_length_is_seen_once_by_every_guard_and_judged_so(
    name: str, rack_name: str
) -> None:
    begins = [FIRST + APART * place for place in range(len(LENGTHS))]
    faults = ", ".join(
        f"{{ kind = 'clock-skip', board = 'clock', tick = {tick}, ticks = {ticks} }}"
        for tick, ticks in zip(begins, LENGTHS, strict=True)
    )
    config = load(name, [f"name={rack_name}", "clock.mode=lockstep", f"fault=[{faults}]"])
    with Rack(config, share=True) as rack:
        rack.run((begins[-1] + APART + AFTER) * config.clock_ns * 1e-9)
        layout, struck = rack.segment.layout, list_strikes(rack.segment, ())
    misses = [event for event in rack.events if event.kind == "miss"]
    for guard in (task.task for task in resolve(config).tasks if task.guards_clock):
        alarms = [e for e in misses if (e.board, e.code) == (guard, "clock_skipped")]
        assert [int(event.value) for event in alarms] == list(LENGTHS)
        assert [event.since for event in alarms] == begins
    verdict = Judge(struck, rack.events, Circumstances(layout, 0, is_lockstep=True)).judge_all()
    assert len(verdict.faults) == len(LENGTHS)
    assert all(fault.seen == "detected" and fault.is_within for fault in verdict.faults)
    # Nobody is blamed for a release that the clock gave late, and nothing is left to explain.
    assert {event.code for event in misses} == {"clock_skipped"}
    assert not verdict.misses
    assert not verdict.unexplained
