"""Fault table: any process fills complete entries, and each task finds its faults."""

from __future__ import annotations

from dataclasses import replace
from time import monotonic_ns

import pytest

from rack.backplane.address_map import FAULT_ENTRIES
from rack.backplane.errors import FaultTableError
from rack.backplane.fault_table import NEVER, FaultTable, Injection, Stage
from rack.backplane.words import System
from tests.backplane.bus import mailbox, task
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, exit_status, fork

WHOLE = Injection(
    kind=3,
    task=1,
    mailbox=0,
    tick=40,
    ticks=8,
    phase=250,
    seed=77,
    when=(0, 1, 2),
    parameters=(0.5, -1.0, 3.25),
)


def test_an_entry_contains_the_injected_fault(make_bus: MakeBus) -> None:
    segment = make_bus(mailbox())
    entry = FaultTable(segment).add_fault(WHOLE)
    read = FaultTable(segment).entries[entry.index]
    assert read.words[1:5].tolist() == [3, 1, 0, 40]
    assert read.words[6:12].tolist() == [8, 250, 77, 0, 1, 2]
    assert read.parameters[:3].tolist() == [0.5, -1.0, 3.25]
    assert (read.stage, read.until, read.struck_tick) == (Stage.WAITING, NEVER, -1)
    assert segment.words[System.INJECTED] == 1
    assert FaultTable(segment).add_fault(replace(WHOLE, when=None)).when_box == -1


def test_the_first_effect_of_a_fault_and_the_delay_to_the_first_visible_one_are_recorded(
    make_bus: MakeBus,
) -> None:
    entry, before = FaultTable(make_bus()).add_fault(Injection(0, 0)), monotonic_ns()
    entry.record_action(9, must_be_found=False)
    first = entry.struck_ns
    assert before <= first <= monotonic_ns()
    assert (entry.struck_tick, entry.count) == (9, 0)
    for tick in (12, 15):
        entry.record_action(tick)
    entry.record_action(16, must_be_found=False)
    assert entry.words[12:16].tolist() == [9, first, 2, 12 - 9]


def test_a_full_table_refuses_another_fault(make_bus: MakeBus) -> None:
    table = FaultTable(make_bus())
    for _ in range(FAULT_ENTRIES):
        table.add_fault(Injection(0, 0))
    with pytest.raises(FaultTableError, match="the fault table is full: 64 faults"):
        table.add_fault(Injection(0, 0))


@pytest.mark.filterwarnings(FORKS)
def test_two_concurrent_injections_take_two_entries(make_bus: MakeBus) -> None:
    segment, each = make_bus(), 15

    def inject(seed: int) -> None:
        table = FaultTable(segment)
        for _ in range(each):
            table.add_fault(Injection(0, 0, seed=seed))

    children = [fork(lambda seed=seed: inject(seed)) for seed in (1, 2, 3)]  # type: ignore[misc]
    assert [exit_status(child) for child in children] == [0, 0, 0]
    entries = FaultTable(segment).list_entries((Stage.WAITING,))
    assert sorted(entry.seed for entry in entries) == sorted([1, 2, 3] * each)
    assert segment.words[System.INJECTED] == 3 * each


def test_a_waiting_fault_can_be_withdrawn_and_an_active_one_cannot(
    make_bus: MakeBus,
) -> None:
    table = FaultTable(make_bus(task("level")))
    entry = table.add_fault(Injection(1, 0, tick=40, when=(2, 1, 7)))
    table.disarm_fault(entry)
    # Neither its tick nor its condition begins it.
    assert (entry.tick, entry.when_box) == (NEVER, -1)
    assert table.free_entry(entry)
    assert entry.stage == Stage.FREE
    begun = table.add_fault(Injection(1, 0, tick=40))
    begun.stage = Stage.ACTIVE
    assert not table.free_entry(begun)
    assert begun.stage == Stage.ACTIVE
    assert table.list_entries((Stage.ACTIVE, Stage.OVER)) == [begun]


def test_waiting_faults_can_be_moved_forward_and_the_clock_notices(make_bus: MakeBus) -> None:
    segment = make_bus(task("level"))
    table = FaultTable(segment)
    entries = [table.add_fault(Injection(1, 0, tick=tick)) for tick in (40, 90, 100)]
    entries[0].stage = Stage.ACTIVE
    before = segment.words[System.INJECTED]
    table.advance_waiting(30)
    assert [entry.tick for entry in entries] == [40, 60, 70]
    assert segment.words[System.INJECTED] != before
