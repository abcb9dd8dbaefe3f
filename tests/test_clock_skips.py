"""Ticks that the clock skips in racks where no board runs in every tick: each skip is seen, however
short."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from rack.boards import Rack
from rack.boards.config import load, resolve
from rack.boards.config.schema import RackConfig
from rack.boards.events import Event
from rack.tools.faults.ending import list_strikes
from rack.tools.faults.judge import Circumstances, FaultVerdict, Judge

pytestmark = pytest.mark.thorough

FIRST, APART = 101, 41
"""First fault, and ticks from one to the next: odd, so that the skips begin in every phase of the
boards."""
LENGTHS = (1, 2, 3, 4) * 4
AFTER = 60
"""Ticks of the run after the last fault."""
RACKS = pytest.mark.parametrize("name", ["hic", "condor"])


@dataclass(frozen=True)
class Skipped:
    """A run of a clock that skips 1 to 4 ticks, in every phase: faults as judged, and alarms by
    guarding board."""

    verdict: FaultVerdict
    alarms: dict[str, list[Event]]
    misses: list[Event]


def disturbed(name: str, rack_name: str, mode: str) -> RackConfig:
    faults = ", ".join(
        f"{{ kind = 'clock-skip', board = 'clock', tick = {FIRST + APART * place}, ticks ="
        f" {ticks} }}"
        for place, ticks in enumerate(LENGTHS)
    )
    return load(name, [f"name={rack_name}", f"clock.mode={mode}", f"fault=[{faults}]"])


def ran(config: RackConfig) -> Skipped:
    guards = [task.task for task in resolve(config).tasks if task.guards_clock]
    with Rack(config, share=True) as rack:
        rack.run((FIRST + APART * len(LENGTHS) + AFTER) * config.clock_ns * 1e-9)
        layout, struck = rack.segment.layout, list_strikes(rack.segment, ())
    misses = [event for event in rack.events if event.kind == "miss"]
    alarms = {
        guard: [e for e in misses if (e.board, e.code) == (guard, "clock_skipped")]
        for guard in guards
    }
    circumstances = Circumstances(layout, 0, is_lockstep=config.clock.mode == "lockstep")
    return Skipped(Judge(struck, rack.events, circumstances).judge_all(), alarms, misses)


@RACKS
@pytest.mark.timeout(120)
def test_a_skip_of_any_length_is_seen_once_by_every_guard_and_judged_so(
    name: str, rack_name: str
) -> None:
    found = ran(disturbed(name, rack_name, "lockstep"))
    for alarms in found.alarms.values():
        assert [int(event.value) for event in alarms] == list(LENGTHS)
        assert [event.since for event in alarms] == [
            FIRST + APART * place for place in range(len(LENGTHS))
        ]
    assert len(found.verdict.faults) == len(LENGTHS)
    assert all(fault.seen == "detected" and fault.is_within for fault in found.verdict.faults)
    # Nobody is blamed for a release that the clock gave late, and nothing is left to explain.
    assert {event.code for event in found.misses} == {"clock_skipped"}
    assert not found.verdict.misses
    assert not found.verdict.unexplained
