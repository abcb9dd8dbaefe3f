"""The stopwatch of a task: traces, counts, and reports to the clock."""

from __future__ import annotations

import time
from typing import Any

import pytest

from rack.backplane.message import State, Status, field
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_done_semaphore
from rack.backplane.trace import SKIPPED_SHIFT, Flag, open_trace_ring
from rack.backplane.watch.alarms import AlarmWriter
from rack.backplane.words import Block, System
from rack.boards.run.ports import InputPorts, OutputPorts
from rack.boards.run.stopwatch import BUS_COUNT_CYCLES, Stopwatch
from tests.backplane.bus import NAME, mailbox, task
from tests.backplane.conftest import MakeBus
from tests.bare_level import BareLevel
from tests.tools.faults.test_ending import box

PERIOD_NS = 2_500_000


class LevelStatus(Status, version=1):
    value: float = field(unit="1", doc="a number")


class Site:
    """A task's stopwatch, ports and rings."""

    def __init__(self, segment: Segment) -> None:
        self.segment = segment
        alarms = AlarmWriter(segment, "level")
        self.level = BareLevel()
        self.inputs = InputPorts(segment, self.level, {"point": NAME}, alarms)
        self.outputs = OutputPorts(
            segment, self.level, {"status": "level.status"}, alarms, self.inputs
        )
        self.watch = Stopwatch(segment, "level", self.inputs, self.outputs)
        self.block = segment.get_block("level")
        self._ring = open_trace_ring(segment, "level")

    def cycle(
        self, tick: int, skipped: int = 0, *, in_time: bool = True, ends_after_ns: int = 0
    ) -> None:
        """Do a cycle that ends so long after its grid point, or at once."""
        watch = self.watch
        watch.start_cycle(tick, skipped)
        watch.read_ns = watch.process_ns = watch.end_ns = (
            watch._release_ns + ends_after_ns if ends_after_ns else watch.start_ns
        )
        watch.finish_cycle(in_time, tick + 1, tick)

    def traced(self) -> dict[str, Any]:
        """Return the newest record."""
        row = self._ring.read_new_rows().rows[-1]
        return dict(zip(row.dtype.names, row.tolist(), strict=True))

    def counts(self, *words: int) -> list[int]:
        return [self.block[word] for word in words]


@pytest.fixture
def site(make_bus: MakeBus) -> Site:
    status = box(LevelStatus, "level.status")
    segment = make_bus(task("level"), task("writer"), mailbox(), status)
    segment.words[System.PERIOD_NS] = PERIOD_NS
    segment.words[System.EPOCH_NS] = time.monotonic_ns()
    return Site(segment)


@pytest.fixture
def stepped(site: Site) -> Site:
    site.segment.words[System.LOCKSTEP] = 1
    for writer in site.outputs.writers.values():
        writer.close()
    return Site(site.segment)


def test_a_cycle_is_traced_with_its_grid_point_and_its_own_processor_time(site: Site) -> None:
    # Before it begins: what is added up below is all within.
    began = time.thread_time_ns()
    site.watch.start_counting()
    begun = time.thread_time_ns()
    while time.thread_time_ns() - begun < 2_000_000:
        continue
    site.cycle(10)
    used = time.thread_time_ns() - began
    first = site.traced()
    assert first["tick"] == 10
    assert first["release_ns"] == site.segment.words[System.EPOCH_NS] + 10 * PERIOD_NS
    assert first["start_ns"] == first["plan_ns"] == first["end_ns"]
    assert 2_000_000 <= first["processor_ns"] <= used + 1_000_000
    assert first["closed_ns"] == 0
    ended = time.monotonic_ns()
    site.cycle(11)
    second = site.traced()
    # Only what it has used since.
    assert second["processor_ns"] <= time.thread_time_ns() - began - first["processor_ns"]
    assert first["end_ns"] <= second["closed_ns"] <= ended
    assert site.counts(Block.CYCLES, Block.DONE) == [2, 11]


def test_a_cycle_beyond_its_deadline_is_missed_and_one_that_ends_with_it_is_not(site: Site) -> None:
    site.cycle(1000, ends_after_ns=PERIOD_NS)
    assert (site.traced()["flags"], site.counts(Block.MISSED)) == (0, [0])
    site.cycle(1001, ends_after_ns=PERIOD_NS + 1)
    assert (site.traced()["flags"], site.counts(Block.MISSED)) == (Flag.MISSED, [1])
    # In time, but a message was too late.
    site.cycle(1002, in_time=False)
    assert (site.traced()["flags"], site.counts(Block.MISSED)) == (Flag.MISSED, [2])


def test_skipped_releases_are_counted_and_recorded_in_the_flags(site: Site) -> None:
    site.cycle(1000, skipped=3)
    flags = site.traced()["flags"]
    assert (flags & 0xFFFF, flags >> SKIPPED_SHIFT) == (Flag.SKIPPED, 3)
    site.cycle(1001, skipped=2)
    assert site.counts(Block.SKIPPED) == [5]


def test_a_cycle_is_late_if_it_is_the_first_follows_skipped_ones_or_begins_late(site: Site) -> None:
    ahead = (time.monotonic_ns() - site.segment.words[System.EPOCH_NS]) // PERIOD_NS + 1000
    site.watch.start_cycle(ahead, 0)
    assert site.watch.is_late
    site.cycle(ahead)
    site.watch.start_cycle(ahead + 1, 0)
    assert not site.watch.is_late
    site.watch.start_cycle(ahead + 1, 1)
    assert site.watch.is_late
    # Its grid point is past, by a period.
    site.segment.words[System.EPOCH_NS] -= PERIOD_NS
    site.watch.start_cycle(0, 0)
    assert site.watch.is_late


def test_a_change_of_the_levels_state_has_its_tick(site: Site) -> None:
    site.cycle(1000)
    assert site.counts(Block.LEVEL_STATE, Block.LEVEL_SINCE) == [0, 0]
    site.level.ports["status"].state = State.EXECUTING
    site.cycle(1001)
    assert site.traced()["state"] == State.EXECUTING
    site.cycle(1002)
    assert site.counts(Block.LEVEL_STATE, Block.LEVEL_SINCE) == [State.EXECUTING, 1001]


def test_in_lockstep_a_cycle_has_no_deadline_and_is_reported(stepped: Site) -> None:
    done = get_done_semaphore(stepped.segment, "level")
    before = time.monotonic_ns()
    stepped.cycle(5, ends_after_ns=100 * PERIOD_NS)
    record = stepped.traced()
    assert record["flags"] == 0
    assert before <= record["release_ns"] == record["start_ns"]
    assert (done.value, stepped.counts(Block.DONE)) == (1, [5])
    stepped.watch.start_cycle(6, 0)
    stepped.watch.finish_idle_cycle()
    assert (done.value, stepped.counts(Block.DONE, Block.CYCLES)) == (2, [6, 2])
    stepped.watch.notify_clock()
    assert done.value == 3


def test_several_releases_given_at_once_are_reported_once(stepped: Site) -> None:
    stepped.block[Block.RELEASED] = 7
    done = get_done_semaphore(stepped.segment, "level")
    for tick, reports in ((5, 0), (6, 0), (7, 1)):
        stepped.cycle(tick)
        assert (stepped.counts(Block.DONE), done.value) == ([tick], reports)


def test_no_report_is_posted_in_real_time(site: Site) -> None:
    site.cycle(5)
    site.watch.finish_idle_cycle()
    site.watch.notify_clock()
    assert get_done_semaphore(site.segment, "level").value == 0


def test_the_clock_is_asked_once_the_deadline_may_have_come(site: Site) -> None:
    words = site.segment.words
    words[System.EPOCH_NS] = time.monotonic_ns() - 1000 * PERIOD_NS
    site.watch.start_cycle(10, 0)
    site.watch.process_ns = site.watch._release_ns + PERIOD_NS - 1
    assert site.watch.find_late_tick(11) is None
    site.watch.process_ns += 1
    now = site.watch.find_late_tick(11)
    assert now is not None
    assert now >= 1000
    assert site.watch.find_late_tick(now + 10**6) is None


def test_failed_reads_are_counted_and_flagged_once(site: Site) -> None:
    reader = site.inputs.readers[NAME]
    site.cycle(1000)
    reader.statistics.corrupt += 2
    reader.statistics.bus_errors += 1
    site.inputs.task.troubles += 1
    site.cycle(1001)
    assert site.traced()["flags"] == Flag.CORRUPT | Flag.BUS_ERROR
    assert site.counts(Block.CORRUPT, Block.BUS_ERRORS) == [2, 1]
    site.cycle(1002)
    assert site.traced()["flags"] == 0
    reader.statistics.corrupt += 1
    site.inputs.task.troubles += 1
    site.cycle(1003)
    assert site.traced()["flags"] == Flag.CORRUPT
    assert site.counts(Block.CORRUPT, Block.BUS_ERRORS) == [3, 1]


def test_bus_counters_are_updated_periodically(site: Site) -> None:
    size = site.segment.layout.find_mailbox("level.status").size
    for tick in range(1000, 1000 + BUS_COUNT_CYCLES):
        site.inputs.read(tick)
        site.outputs.write(tick, None)
        assert site.counts(Block.READS, Block.WRITES) == [0, 0]
        site.cycle(tick)
    assert site.counts(Block.READS, Block.WRITES, Block.READ_BYTES, Block.WRITE_BYTES) == [
        BUS_COUNT_CYCLES,
        BUS_COUNT_CYCLES,
        0,
        BUS_COUNT_CYCLES * size,
    ]
    site.watch.update_bus_counters()
    assert site.counts(Block.READS, Block.WRITES) == [BUS_COUNT_CYCLES] * 2
    # A restarted task does not count again what its predecessor wrote.
    site.outputs.writers["status"].close()
    Site(site.segment).watch.update_bus_counters()
    assert site.counts(Block.READS, Block.WRITES) == [BUS_COUNT_CYCLES] * 2
