"""A running board at real-time priority: no page fault in its cycles, after the first ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.backplane.trace import Flag, open_trace_ring
from rack.backplane.words import Block, System
from rack.boards import Rack
from tests.boards.conftest import PLAIN, MakeConfig
from tests.boards.runs import stop, watch_until
from tests.machine import needs_fifo

pytestmark = pytest.mark.slow

FIRST = 40
"""Cycles in which a process may still meet a page for the first time."""
PART = 40
PARTS = 19
"""Parts of a run in which every cycle was in time: a late cycle takes other ways, and meets their
pages."""
STRAY = 2
"""Faults permitted in all these cycles together: the machine may move a page."""
PRIORITIES = ("clock.priority=90", "board.wave.priority=80", "board.watch.priority=70")


@pytest.mark.thorough
@needs_fifo
def test_no_page_fault_comes_in_a_cycle_after_the_first_ones(config: MakeConfig) -> None:
    with Rack(config("clock.mode=realtime", *PRIORITIES, text=PLAIN)) as rack:
        rack.start()
        words = rack.segment.words
        # The fast board: slower ones have time for page faults.
        pid, ring = rack.segment.get_block("wave")[Block.PID], open_trace_ring(rack.segment, "wave")
        found: list[int] = []
        until = FIRST
        before: int | None = None
        while len(found) < PARTS:
            watch_until(rack, lambda until=until: words[System.TICK] >= until)  # type: ignore[misc]
            until = words[System.TICK] + PART
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            # Minor and major page faults so far.
            now = int(fields[7]) + int(fields[9])
            rows, lost = ring.read_new_rows()
            lost_cycles = rows["flags"] & (Flag.MISSED | Flag.SKIPPED)
            late_ns = (rows["start_ns"] - rows["release_ns"]).max(initial=0)
            is_quiet = not lost_cycles.any() and late_ns < words[System.PERIOD_NS] // 2
            if before is not None and len(rows) >= PART // 2 and is_quiet and not lost:
                found.append(now - before)
            before = now
        stop(rack)
    assert sum(found) <= STRAY
