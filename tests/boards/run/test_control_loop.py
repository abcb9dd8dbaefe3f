"""One cycle of a task: its counts, its trace, and the age of the information it passes on."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from rack.backplane.fault_table import FaultTable, Injection, Stage
from rack.backplane.mailbox.protocols import MailboxLock
from rack.backplane.mailbox.slots import Slots
from rack.backplane.segment import Segment
from rack.backplane.trace import Flag, open_trace_ring
from rack.backplane.watch.alarms import Alarm, open_alarm_ring
from rack.backplane.words import Block, System
from rack.boards.config import Resolved, resolve
from rack.boards.faults.kind import KINDS
from rack.boards.run import control_loop
from rack.boards.run.control_loop import PlannerLoop, VirtualControlLoop
from rack.levels.level import Executor, Planner
from rack.levels.references import find_class
from tests.boards.conftest import MakeConfig, MakeSegment
from tests.processes import FORKS

pytestmark = pytest.mark.filterwarnings(FORKS)
TROUBLE = Flag.MISSED | Flag.SKIPPED | Flag.BUS_ERROR | Flag.CORRUPT
HOUR_NS = 3_600_000_000_000
MakeBench = Callable[..., "Bench"]


class Bench:
    """A wired rack whose tasks are cycled by the test; the clock stands at tick 0 and a tick lasts
    an hour."""

    def __init__(self, plan: Resolved, segment: Segment) -> None:
        self.plan = plan
        self.segment = segment
        self.segment.words[System.PERIOD_NS] = HOUR_NS
        self.to(0)

    def to(self, tick: int) -> None:
        """Set the clock to the middle of a tick."""
        self.segment.words[System.EPOCH_NS] = time.monotonic_ns() - tick * HOUR_NS - HOUR_NS // 2

    def task(self, name: str) -> VirtualControlLoop | PlannerLoop:
        wiring = next(wiring for wiring in self.plan.tasks if wiring.task == name)
        if name.endswith(".planner"):
            return PlannerLoop(
                self.segment, wiring, find_class(wiring.target, Planner)(wiring.context), None
            )
        return VirtualControlLoop(
            self.segment, wiring, find_class(wiring.target, Executor)(wiring.context), None
        )

    def cycle(self, tick: int, *tasks: VirtualControlLoop | PlannerLoop) -> None:
        """Cycle tasks in the middle of a tick, one after the other."""
        self.to(tick)
        for task in tasks:
            task.cycle(tick)

    def flags(self, name: str) -> list[Flag]:
        """Return the trouble in every cycle of a task so far."""
        return [
            Flag(int(flags)) & TROUBLE
            for flags in open_trace_ring(self.segment, name).read_new_rows().rows["flags"]
        ]


@pytest.fixture
def bench(config: MakeConfig, make_segment: MakeSegment) -> MakeBench:
    def make(*settings: str) -> Bench:
        plan = resolve(config("clock.mode=realtime", *settings))
        return Bench(plan, make_segment(plan.layout, ""))

    return make


def test_a_slow_level_may_use_its_whole_cycle(bench: MakeBench) -> None:
    rack = bench()
    watch = rack.task("watch")
    rack.to(7)
    watch.cycle(0)
    rack.to(16)
    watch.cycle(8)
    assert rack.flags("watch") == [Flag(0), Flag.MISSED]


def test_a_damaged_message_shows_in_the_trace_of_its_reader(bench: MakeBench) -> None:
    rack = bench()
    wave, watch = rack.task("wave"), rack.task("watch")
    wave.cycle(0)
    slots = Slots(rack.segment, rack.segment.layout.find_mailbox("wave.status"))
    assert slots.fetch_message(1)
    for place in slots.places:
        place[:] = bytes(b ^ 0x80 for b in place)
    rack.cycle(8, watch)
    rack.cycle(15, wave)
    rack.cycle(16, watch)
    assert rack.flags("watch") == [Flag.CORRUPT, Flag(0)]
    assert rack.segment.get_block("watch")[Block.CORRUPT] == 1


def test_an_access_that_times_out_is_traced_and_the_cycle_continues(bench: MakeBench) -> None:
    rack = bench("protocol.mailbox={ 'wave.status' = 'lock' }")
    wave, watch = rack.task("wave"), rack.task("watch")
    wave.cycle(0)
    watch.cycle(0)
    # Somebody is in the critical section, and stays.
    holder = MailboxLock(rack.segment, "wave.status")
    assert holder.acquire()
    rack.cycle(8, watch, wave)
    assert rack.flags("watch") == [Flag(0), Flag.BUS_ERROR]
    # A failed write is a missed deadline.
    assert rack.flags("wave") == [Flag(0), Flag.BUS_ERROR | Flag.MISSED]
    assert [rack.segment.get_block(name)[Block.BUS_ERRORS] for name in ("wave", "watch")] == [1, 1]


def test_the_update_of_a_plan_is_stamped_inside_the_critical_section(
    bench: MakeBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What is outside the executor may preempt: that is no fault of the update.
    rack = bench("board.wave.priority=50", "protocol.default=lock")
    called: list[int] = []
    monkeypatch.setattr(
        control_loop, "set_priority", lambda priority: called.append(time.monotonic_ns())
    )
    rack.task("wave.planner").cycle(0)
    (row,) = open_trace_ring(rack.segment, "wave.planner").read_new_rows().rows
    entered, left = called
    assert entered <= row["process_ns"] <= row["end_ns"] <= left


def test_a_planner_traces_plans_but_not_idle_cycles(bench: MakeBench) -> None:
    rack = bench("board.wave.params.plan_every=4")
    planner = rack.task("wave.planner")
    for tick in (0, 4, 5, 6, 8):
        rack.cycle(tick, planner)
    rows = open_trace_ring(rack.segment, "wave.planner").read_new_rows().rows
    assert rows["tick"].tolist() == [0, 4, 8]
    assert (rows["flags"] & Flag.PLANNED).all()
    block = rack.segment.get_block("wave.planner")
    assert [block[w] for w in (Block.CYCLES, Block.PLANS, Block.DONE, Block.MISSED)] == [5, 3, 8, 0]


@pytest.mark.parametrize(("now", "trouble"), [(5, Flag.SKIPPED), (10, Flag.SKIPPED | Flag.MISSED)])
def test_a_release_without_a_plan_is_traced_after_skipped_ones(
    bench: MakeBench, now: int, trouble: Flag
) -> None:
    rack = bench("board.wave.params.plan_every=4")
    planner = rack.task("wave.planner")
    planner.cycle(0)
    # Its slice is four ticks: at tick 10 that of the release at 5 is over.
    planner.next_cycle.skipped = 1
    rack.to(now)
    planner.cycle(5)
    assert rack.flags("wave.planner") == [Flag(0), trouble]
    block = rack.segment.get_block("wave.planner")
    words = (Block.CYCLES, Block.PLANS, Block.DONE, Block.SKIPPED)
    assert [block[word] for word in words] == [2, 1, 5, 1]


def test_a_pause_in_reading_is_noted_in_a_cycle_that_begins_late(bench: MakeBench) -> None:
    rack = bench()
    watch = rack.task("watch")
    rack.cycle(8, watch)
    assert watch.inputs.task.since == 8
    rack.cycle(16, watch)
    assert watch.inputs.task.since == 8
    watch.next_cycle.skipped = 1
    rack.cycle(32, watch)
    assert watch.inputs.task.since == 32


def test_the_load_of_a_fault_is_computed_in_its_cycle(bench: MakeBench) -> None:
    rack = bench()
    wave = rack.task("wave")
    at = [task.name for task in rack.segment.layout.processes].index("wave")
    kind = KINDS["overrun"]
    entry = FaultTable(rack.segment).add_fault(Injection(kind.number, at, parameters=(0.0, 0.0)))
    entry.stage = Stage.ACTIVE
    wave.faults.refresh_faults(0)
    rack.cycle(0, wave)
    assert entry.count == 1
    assert entry.struck_tick == 0


def test_a_user_defined_finding_raises_one_alarm_per_episode(bench: MakeBench) -> None:
    breaks = [*range(30), 49, 70, 100]
    rack = bench("board.wave.executor=wave_levels:Surf", f"board.wave.params.breaks={breaks}")
    wave = rack.task("wave")
    for tick in range(110):
        rack.cycle(tick, wave)
    rows = open_alarm_ring(rack.segment, "wave").read_new_rows().rows
    assert set(rows["code"]) == {Alarm.OWN}
    # It begins anew when it was not found for more than 20 cycles.
    assert [(int(row["tick"]), bytes(row["text"]).decode()) for row in rows] == [
        (tick, f"tick {tick}") for tick in (0, 70, 100)
    ]
