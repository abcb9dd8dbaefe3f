"""A running board at real-time priority: no page fault in its cycles, after the first ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.backplane.words import Block, System
from rack.boards import Rack
from tests.boards.conftest import PLAIN, MakeConfig
from tests.machine import needs_fifo
from tests.processes import in_thread, wait_until

pytestmark = pytest.mark.slow

FIRST = 40
"""Cycles in which a process may still meet a page for the first time."""
LATER = 760
STRAY = 2
"""Faults permitted in all later cycles together: the machine may move a page."""
PRIORITIES = ("clock.priority=90", "board.wave.priority=80", "board.watch.priority=70")


def faults_of(pid: int) -> int:
    """Return the page faults of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[7]) + int(fields[9])


@needs_fifo
def test_no_page_fault_comes_in_a_cycle_after_the_first_ones(config: MakeConfig) -> None:
    rack = Rack(config("clock.mode=realtime", *PRIORITIES, text=PLAIN))
    found: dict[str, list[int]] = {}
    with rack:
        words = rack.segment.words
        # The fast board: slower ones have time for page faults.
        pids = {"wave": rack.segment.get_block("wave")[Block.PID]}

        def count() -> None:
            for ticks in (FIRST, FIRST + LATER):
                wait_until(lambda ticks=ticks: words[System.TICK] >= ticks)  # type: ignore[misc]
                for name, pid in pids.items():
                    found.setdefault(name, []).append(faults_of(pid))

        with in_thread(count):
            rack.run((FIRST + LATER + 100) * 2.5e-3)
    assert max(last - first for first, last in found.values()) <= STRAY
