"""The course of faults in lockstep: it depends on ticks alone, however long a cycle takes that is
under way."""

from __future__ import annotations

import signal
import time
from typing import Any

import pytest

from rack.backplane.clock.lockstep import LockstepDriver
from rack.backplane.clock.wake import NextCycle
from rack.backplane.fault_table import NEVER, FaultEntry, FaultTable, Injection, Stage
from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.process import STOPPED_STATES, WAITING_STATES, is_alive, read_state
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_done_semaphore
from rack.backplane.watch.alarms import Alarm, open_alarm_ring
from rack.backplane.words import Block, Run, System
from rack.boards.faults.clock_board import FaultStage
from rack.boards.faults.kind import KINDS
from tests.backplane.bus import NAME, mailbox, task
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, forked, in_thread, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)

CYCLE_S = 0.05
"""Longer than the clock takes for all ticks of the slow task's period."""


def test_no_fault_begins_or_ends_during_a_cycle(make_bus: MakeBus) -> None:
    segment = make_bus(task("writer", every=8), mailbox(every=8, delay=8))
    segment.words[System.LOCKSTEP] = 1
    table = FaultTable(segment)
    entry = table.add_fault(Injection(KINDS["mute"].number, 0, mailbox=0, tick=3, ticks=6))
    cycle, seen = NextCycle(segment, "writer"), []

    def serve() -> None:
        while (tick := cycle.wait()) is not None:
            seen.append((tick, entry.stage))
            time.sleep(CYCLE_S)
            seen.append((tick, entry.stage))
            segment.get_block("writer")[Block.DONE] = tick
            get_done_semaphore(segment, "writer").release()

    driver = LockstepDriver(segment, lambda _: 24, False, 8)
    stage = FaultStage(segment, driver)

    class Controller:
        def begin_tick(self, tick: int) -> None:
            if tick >= stage.next_tick or segment.words[System.INJECTED] != stage.injected:
                stage.advance_faults(tick)

        def finish_release(self, tick: int) -> None:
            stage.act_within_tick(tick)

    driver.controller = Controller()
    with in_thread(serve):
        driver.run()
    stages = (0, Stage.WAITING), (8, Stage.ACTIVE), (16, Stage.OVER)
    assert seen == [at for at in stages for _ in range(2)]
    assert (entry.tick, entry.until) == (3, 9)


class Site:
    """Two mailboxes, of a writer and of another task, and the clock's faults, tick by tick."""

    def __init__(self, segment: Segment) -> None:
        self.segment = segment
        segment.words[System.LOCKSTEP], segment.words[System.PERIOD_NS] = 1, 2_500_000
        self.table = FaultTable(segment)
        self.driver = LockstepDriver(segment, lambda _: None, False, 8)
        self.stage = FaultStage(segment, self.driver)
        self._ring = open_alarm_ring(segment, "clock")
        self.write_other = open_writer(segment, "other.point")

    def add(self, kind: str, task: int = 0, **more: Any) -> FaultEntry:
        """Add a fault, of the writer if nothing else is said."""
        number, defaults = KINDS[kind].number, [p.default or 1.0 for p in KINDS[kind].parameters]
        return self.table.add_fault(Injection(number, task, parameters=tuple(defaults), **more))

    def advance(self, *ticks: int) -> list[tuple[Alarm, int, int, float]]:
        """Go through these ticks; return code, tick, subject and value of the alarms."""
        for tick in ticks:
            self.stage.advance_faults(tick)
        rows = self._ring.read_new_rows().rows
        return [
            (Alarm(row["code"]), int(row["tick"]), int(row["subject"]), float(row["value"]))
            for row in rows
        ]


@pytest.fixture
def site(make_bus: MakeBus) -> Site:
    tasks = task("writer"), task("reader", slot=3), task("other", slot=4)
    return Site(make_bus(*tasks, mailbox(), mailbox(name="other.point", writer="other")))


def test_a_fault_lasts_from_its_tick_for_its_ticks(site: Site) -> None:
    entry = site.add("mute", tick=5, ticks=3)
    generation = site.table.generation
    assert (site.advance(3, 4), entry.stage) == ([], Stage.WAITING)
    assert site.stage.next_tick == 5
    assert site.advance(5) == [(Alarm.FAULT_BEGINS, 5, entry.index, 0.0)]
    assert site.stage.next_tick == 8
    assert (entry.tick, entry.until, entry.stage) == (5, 8, Stage.ACTIVE)
    assert site.table.generation == generation + 1
    assert site.advance(6, 7) == []
    entry.count = 2
    assert site.advance(8) == [(Alarm.FAULT_ENDS, 8, entry.index, 2.0)]
    assert (entry.until, entry.stage) == (8, Stage.OVER)
    assert site.table.generation == generation + 2
    assert (site.advance(9), site.stage.injected) == ([], 1)


def test_a_fault_of_the_clock_that_strikes_once_is_over_a_tick_later(site: Site) -> None:
    entry = site.add("clock-skip", task=-1, tick=5)
    assert site.driver.skip == 0
    site.advance(5)
    assert (entry.until, site.driver.skip) == (6, 1)
    assert (entry.struck_tick, entry.count) == (5, 1)
    (ended,) = [alarm for alarm in site.advance(6) if alarm[0] is Alarm.FAULT_ENDS]
    assert ended == (Alarm.FAULT_ENDS, 6, entry.index, 1.0)


def test_messages_that_flow_again_after_a_message_fault_are_reported(site: Site) -> None:
    writer = open_writer(site.segment, NAME)
    site.add("mute", tick=2, ticks=3)
    site.advance(2)
    writer.write(3)
    site.advance(5)
    box = site.segment.layout.mailboxes.index(site.segment.layout.find_mailbox(NAME))
    # A message made while it was active is none of those after it.
    assert (site.stage.next_tick, site.advance(6)) == (6, [])
    site.write_other.write(6)
    assert site.advance(7, 8) == []
    writer.write(8)
    # Visible a tick later, and read as of the tick before.
    assert site.advance(9) == []
    assert site.advance(10) == [(Alarm.FLOWS, 10, box, 5.0)]
    assert (site.stage.next_tick, site.advance(11)) == (NEVER, [])


def test_a_restarted_clock_awaits_the_same_messages(site: Site) -> None:
    site.add("mute", tick=2, ticks=3)
    site.advance(2, 5)
    site.segment.words[System.STATE] = Run.RUNNING
    site.stage = FaultStage(site.segment, site.driver)
    open_writer(site.segment, NAME).write(5)
    assert site.advance(6, 7) == [(Alarm.FLOWS, 7, 0, 2.0)]


def test_a_condition_holds_as_of_the_tick_before(site: Site) -> None:
    entry = site.add("mute", when=(1, 0, 7), ticks=1)
    site.write_other.message.id = 6
    site.write_other.write(0)
    assert site.advance(1, 2) == []
    site.write_other.message.id = 7
    site.write_other.write(2)
    assert site.advance(3) == []
    assert site.advance(4) == [(Alarm.FAULT_BEGINS, 4, entry.index, 0.0)]


def test_a_kill_needs_a_process_and_waits_until_its_loss_is_known(site: Site) -> None:
    absent = site.add("kill", tick=1)
    site.advance(1)
    assert (absent.count, absent.stage) == (0, Stage.ACTIVE)
    block = site.segment.get_block("writer")
    with forked(signal.pause) as pid:
        block[Block.PID] = pid

        def crate() -> None:
            wait_until(lambda: not is_alive(pid))
            block[Block.LOST] = 3
            site.segment.words[System.LOSSES] += 2
            get_done_semaphore(site.segment, "writer").release()

        entry = site.add("kill", tick=2)
        with in_thread(crate):
            site.advance(2)
        assert not is_alive(pid)
        assert (entry.count, entry.struck_tick) == (1, 2)
    # Its process is gone: there is nobody to strike.
    again = site.add("kill", tick=3)
    site.advance(3)
    assert again.count == 0


def test_a_hanging_task_continues_at_the_end_of_its_fault_unless_it_is_lost(site: Site) -> None:
    block = site.segment.get_block("writer")
    with forked(signal.pause) as pid:
        block[Block.PID] = pid
        site.add("hang", tick=1, ticks=3)
        site.advance(1)
        wait_until(lambda: read_state(pid) in STOPPED_STATES)
        target = next(one for one in site.driver.tasks if one.spec.name == "writer")
        assert target.is_stopped
        site.advance(4)
        wait_until(lambda: read_state(pid) in WAITING_STATES)
        assert not target.is_stopped
        lasting = site.add("hang", tick=5)
        site.advance(5)
        wait_until(lambda: read_state(pid) in STOPPED_STATES)
        block[Block.LOST] = 7
        site.advance(6)
        assert (lasting.stage, lasting.until) == (Stage.OVER, 6)
        assert read_state(pid) in STOPPED_STATES


def test_in_real_time_a_fault_with_a_phase_strikes_within_its_tick(site: Site) -> None:
    site.segment.words[System.LOCKSTEP] = 0
    site.segment.words[System.EPOCH_NS] = time.monotonic_ns() - 5 * 2_500_000
    site.stage = FaultStage(site.segment, site.driver)
    entry = site.add("clock-skip", task=-1, tick=5, phase=900)
    site.advance(5)
    assert (entry.count, entry.stage) == (0, Stage.ACTIVE)
    site.stage.act_within_tick(5)
    assert entry.count == 1
    assert entry.struck_ns >= site.segment.words[System.EPOCH_NS] + 5.9 * 2_500_000
    site.stage.act_within_tick(6)
    assert entry.count == 1


def test_a_babble_floods_the_rings_while_it_lasts(site: Site) -> None:
    site.add("babble", tick=2, ticks=2)
    flooded = []
    for tick in range(1, 5):
        site.advance(tick)
        flooded.append(site.driver.is_flooded)
    assert flooded == [False, True, True, False]
