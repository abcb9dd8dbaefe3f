"""Faults of one task: the hog takes a core when its fault begins, and not before; what computing
time costs."""

from __future__ import annotations

import os
import time
from unittest.mock import Mock

import pytest

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.fault_table import FaultTable, Injection, Stage
from rack.backplane.process import read_processor_ns
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, System
from rack.boards.faults.kind import KINDS, find_kind
from rack.boards.faults.tasks import (
    ExtraComputing,
    LoadStep,
    TaskFaults,
    compute_cycle_end,
    compute_slice_end,
    take_core,
)
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus
from tests.machine import needs_fifo
from tests.processes import BOUND_S, FORKS, exit_status, forked, wait_until

LEAST_S = 0.5
"""Time for which the hog waits: its processor time is known to 10 ms."""


@pytest.mark.slow
@needs_fifo
@pytest.mark.filterwarnings(FORKS)
def test_a_hog_that_waits_for_the_start_leaves_the_core_to_others(make_bus: MakeBus) -> None:
    segment = make_bus(task("level"))
    segment.words[System.PERIOD_NS] = 2_500_000
    segment.get_block("level")[Block.CORE] = 0
    entry = FaultTable(segment).add_fault(Injection(KINDS["hog"].number, 0, tick=40, ticks=400))
    with forked(lambda: take_core(segment, entry)) as pid:
        begun = time.monotonic()
        wait_until(lambda: time.monotonic() - begun > LEAST_S, BOUND_S)
        assert read_processor_ns(pid) < 0.5 * (time.monotonic() - begun) * 1e9
        assert os.sched_getaffinity(pid) == {0}
        segment.words[System.STATE] = Run.STOPPED
        assert exit_status(pid) == 0


def load(segment: Segment, kind: str, until: LoadStep, *parameters: float) -> ExtraComputing:
    """Return extra computing time of a task of three ticks, whose plans have two cycles."""
    entry = FaultTable(segment).add_fault(
        Injection(KINDS[kind].number, 0, tick=0, seed=5, parameters=parameters)
    )
    level = task("level", every=3, within_cycles=2)
    return ExtraComputing(entry, level, SystemClock(segment), until)


def test_extra_computing_takes_the_time_that_its_step_asks_for(make_bus: MakeBus) -> None:
    ends: list[int] = []

    def step(of: ExtraComputing, tick: int, now: int) -> int:
        ends.append(now + tick * 1_000_000)
        return ends[-1]

    extra = load(make_bus(task("level")), "overrun", step, 1.0)
    begun = time.monotonic_ns()
    extra.burn_time(20)
    assert time.monotonic_ns() >= ends[0] >= begun + 20_000_000
    assert (extra.entry.count, extra.entry.struck_tick) == (1, 20)


def test_an_executor_overruns_by_cycles_and_a_planner_beyond_its_slice(make_bus: MakeBus) -> None:
    segment = make_bus(task("level"))
    segment.words[System.PERIOD_NS] = period = 2_500_000
    segment.words[System.EPOCH_NS] = epoch = 1_000_000_000
    overrun = load(segment, "overrun", compute_cycle_end, 2.0, 0.0)
    assert compute_cycle_end(overrun, 4, 77) == 77 + 2 * 3 * period
    random = load(segment, "overrun", compute_cycle_end, 2.0, 1.0)
    drawn = [compute_cycle_end(random, tick, 0) for tick in range(50)]
    assert drawn == [compute_cycle_end(random, tick, 0) for tick in range(50)]
    assert 0 <= min(drawn) < max(drawn) <= 2 * 3 * period
    assert len(set(drawn)) == 50
    late = load(segment, "planner-slow", compute_slice_end, 2.0)
    slice_end = epoch + (4 + 3 * 2) * period
    assert compute_slice_end(late, 4, 0) == slice_end + 2 * 3 * period
    # One that is beyond its slice already has them added.
    assert compute_slice_end(late, 4, slice_end + 5) == slice_end + 5 + 2 * 3 * period


def test_a_task_has_the_faults_that_are_active_by_its_tick(make_bus: MakeBus) -> None:
    segment = make_bus(task("level"), task("other"))
    table = FaultTable(segment)
    level, outputs = Mock(), Mock()
    faults = TaskFaults(segment, segment.layout.find_task("level"), outputs, level)
    entries = [
        table.add_fault(Injection(KINDS[kind].number, 0, tick=4, seed=9, parameters=(1.0,)))
        for kind in ("overrun", "drop", "sensor-bias", "hog")
    ]
    table.add_fault(Injection(KINDS["drop"].number, 1, tick=4))

    def applied() -> list[str]:
        """The faults that the task's ports were given last."""
        (given,) = outputs.call_args.args
        return [find_kind(entry).name for entry in given]

    assert (faults.refresh_faults(3), faults.loads, applied()) == (table.generation, [], [])
    for entry in entries:
        entry.stage = Stage.ACTIVE
        entry.tick = 4
    # The clock works ahead: for this task they begin a tick later.
    assert (faults.refresh_faults(3), faults.loads, applied()) == (-1, [], [])
    assert faults.refresh_faults(4) == table.generation
    assert [load.entry.kind for load in faults.loads] == [KINDS["overrun"].number]
    assert applied() == ["drop"]
    ((struck,),) = level.inject.call_args.args
    assert (struck.kind, struck.seed, struck.since) == ("sensor-bias", 9, 4)
    faults.count_actions({0: True}, 6)
    assert (entries[2].count, entries[2].struck_tick) == (1, 6)
    faults.burn_time(7)
    assert (entries[0].count, entries[0].struck_tick) == (1, 7)


def test_a_simulated_hog_acts_once_a_cycle_of_its_task(make_bus: MakeBus) -> None:
    segment = make_bus(task("level"), task("other"))
    segment.words[System.LOCKSTEP] = 1
    entry = FaultTable(segment).add_fault(Injection(KINDS["hog"].number, 0, tick=4))
    entry.stage, entry.tick, entry.until = Stage.ACTIVE, 4, 10
    level, other = (
        TaskFaults(segment, segment.layout.find_task(name), Mock(), Mock())
        for name in ("level", "other")
    )
    other.refresh_faults(5)
    assert (other.taken_until, entry.count) == (10, 0)
    level.refresh_faults(5)
    assert (level.taken_until, entry.count, entry.struck_tick) == (10, 1, 5)
