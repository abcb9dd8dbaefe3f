"""The course of faults in lockstep: it depends on ticks alone, however long a cycle takes that is
under way."""

from __future__ import annotations

import threading
import time

from rack.backplane.clock.lockstep import LockstepDriver
from rack.backplane.clock.wake import NextCycle
from rack.backplane.fault_table import Entry, FaultTable, Injection, Stage
from rack.backplane.semaphores import done_semaphore
from rack.backplane.words import Block, System
from rack.boards.faults.clock_board import FaultStage
from rack.boards.faults.kind import KINDS
from tests.backplane.bus import mailbox, task
from tests.backplane.conftest import MakeBus, make_bus  # noqa: F401  a fixture
from tests.processes import BOUND_S

CYCLE_S = 0.05
"""Longer than the clock takes for all ticks of the slow task's period."""


def test_no_fault_begins_or_ends_during_a_cycle(make_bus: MakeBus) -> None:  # noqa: F811
    segment = make_bus(task("writer", every=8), mailbox(every=8, delay=8))
    segment.words[System.LOCKSTEP] = 1
    table = FaultTable(segment)
    entry = table.add(Injection(KINDS["mute"].number, 0, mailbox=0, tick=3, ticks=6))
    cycle, seen = NextCycle(segment, "writer"), []

    def serve() -> None:
        while (tick := cycle.wait()) is not None:
            seen.append((tick, entry.stage))
            time.sleep(CYCLE_S)
            seen.append((tick, entry.stage))
            segment.block("writer")[Block.DONE] = tick
            done_semaphore(segment.rack, "writer").release()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    driver = LockstepDriver(segment, lambda _: 24, False, 8)
    stage = FaultStage(segment, driver)

    class Controller:
        def begin(self, tick: int) -> None:
            if stage.open or segment.words[System.INJECTED] != stage.injected:
                stage.advance(tick)

        def released(self, tick: int) -> None:
            stage.within(tick)

    driver.controller = Controller()
    driver.run()
    thread.join(BOUND_S)
    assert seen == [
        (tick, at)
        for tick, at in ((0, Stage.WAITING), (8, Stage.ACTIVE), (16, Stage.OVER))
        for _ in "ab"
    ]
    assert (entry[Entry.FROM], entry[Entry.UNTIL]) == (3, 9)
