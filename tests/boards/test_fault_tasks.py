"""The hog: it takes a core when its fault begins, and not before."""

from __future__ import annotations

import time

import pytest

from rack.backplane.fault_table import FaultTable, Injection
from rack.backplane.process import processor_ns
from rack.backplane.words import Block, Run, System
from rack.boards.faults.kind import KINDS
from rack.boards.faults.tasks import take_core
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus, make_bus  # noqa: F401  a fixture
from tests.machine import needs_fifo
from tests.processes import BOUND_S, FORKS, exit_status, forked, wait_until

LEAST_S = 0.5
"""Time for which the hog waits: its processor time is known to 10 ms."""


@needs_fifo
@pytest.mark.filterwarnings(FORKS)
def test_a_hog_that_waits_for_the_start_leaves_the_core_to_others(make_bus: MakeBus) -> None:  # noqa: F811
    segment = make_bus(task("level"))
    segment.words[System.PERIOD_NS] = 2_500_000
    segment.block("level")[Block.CORE] = 0
    entry = FaultTable(segment).add(Injection(KINDS["hog"].number, 0, tick=40, ticks=400))
    with forked(lambda: take_core(segment, entry)) as pid:
        begun = time.monotonic()
        wait_until(lambda: time.monotonic() - begun > LEAST_S, BOUND_S)
        assert processor_ns(pid) < 0.5 * (time.monotonic() - begun) * 1e9
        segment.words[System.STATE] = Run.STOPPED
        assert exit_status(pid) == 0
