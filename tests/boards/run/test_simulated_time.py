"""Computing that takes simulated time in lockstep: late outputs, missed releases, alarms."""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest

from rack.backplane.trace import SKIPPED_SHIFT, Flag
from rack.backplane.words import Block
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.events import Event
from tests.boards.conftest import MakeConfig
from tests.boards.messages import Written
from tests.boards.runs import faulty

SECONDS = 0.25
FIRST = 40
LONG_S, LAST = 0.5, 200
LONG, BELOW, EXACT, CARRIED, STARVED, WATCH, PLAN = 40, 56, 64, 72, 96, 128, 160
"""Ticks of the faults of one run, each of which is over before the next: multiples of the watch's
eight."""
WAVE: dict[str, Any] = {"kind": "overrun", "board": "wave", "cycles": 1}
FAULTS: tuple[dict[str, Any], ...] = (
    {**WAVE, "tick": LONG, "by": 2.5},
    {**WAVE, "tick": BELOW, "by": 0.9},
    {**WAVE, "tick": EXACT, "by": 1.0},
    {**WAVE, "tick": CARRIED, "cycles": 6, "by": 1.5},
    {**WAVE, "tick": STARVED, "by": 20.0},
    {**WAVE, "board": "watch", "tick": WATCH, "by": 1.5},
    {
        "kind": "planner-slow",
        "board": "wave.planner",
        "tick": PLAN,
        "cycles": 1,
        "by": 0.5,
    },
)


def end_of(first: int) -> int:
    """Return the tick of the fault after that at a tick."""
    return min((fault["tick"] for fault in FAULTS if fault["tick"] > first), default=LAST)


class Ran(NamedTuple):
    """A run with faults."""

    digest: str
    written: Written
    events: tuple[Event, ...]
    blocks: dict[str, list[int]]

    def ticks(self, code: str, board: str, first: int = 0, end: int = LAST) -> list[int]:
        """Return the ticks of the events of a kind about a board."""
        found = [
            event.tick for event in self.events if (event.code, event.subject) == (code, board)
        ]
        return [tick for tick in found if first <= tick < end]

    def cycle(self, task: str, tick: int) -> tuple[Flag, int]:
        """Return the flags of a cycle, and the number of releases skipped before it."""
        rows = self.written.cycles[task]
        flags = int(rows["flags"][rows["tick"] == tick][0])
        low = (1 << SKIPPED_SHIFT) - 1
        return Flag(flags & low) & (Flag.MISSED | Flag.SKIPPED), flags >> SKIPPED_SHIFT

    def lost(self, task: str, first: int) -> tuple[int, int]:
        """Return how many deadlines a task missed and how many releases it skipped because of the
        fault at a tick."""
        ticks = self.written.cycles[task]["tick"]
        cycles = [self.cycle(task, int(tick)) for tick in ticks if first <= tick < end_of(first)]
        missed = sum(Flag.MISSED in flags for flags, _ in cycles)
        return missed, sum(skipped for _, skipped in cycles)

    def visible(self, mailbox: str, tick: int) -> int:
        """Return the tick at which the message of a cycle is visible."""
        rows = self.written.messages[mailbox]
        return int(rows["visible_at"][rows["tick"] == tick][0])


def run(config: MakeConfig, *settings: str, **fault: Any) -> Ran:
    """Run the rack of the waves with one fault from tick `FIRST` on."""
    return run_faults(config(*settings), {"tick": FIRST, **fault}, seconds=SECONDS)


def run_faults(config: RackConfig, *faults: dict[str, Any], seconds: float = LONG_S) -> Ran:
    """Run a rack with faults."""
    with Rack(faulty(config, *faults)) as rack:
        digest = rack.run(seconds).digest
        words = (Block.MISSED, Block.SKIPPED, Block.PLANS)
        blocks = {
            task.name: [rack.segment.get_block(task.name)[word] for word in words]
            for task in rack.segment.layout.tasks
        }
        return Ran(digest, Written.on(rack.segment), tuple(rack.events), blocks)


RUNS: list[Ran] = []


@pytest.fixture
def overrun(config: MakeConfig) -> Ran:
    """The run with all of `FAULTS`; all tests of this file share it."""
    if not RUNS:
        RUNS.append(run_faults(config(), *FAULTS))
    return RUNS[0]


def test_an_overrun_shows_its_messages_late_and_skips_releases(overrun: Ran) -> None:
    # It computes until the middle of tick 42, and then begins late with the release at 42.
    assert overrun.visible("wave.status", LONG) == LONG + 3
    assert LONG + 1 not in overrun.written.cycles["wave"]["tick"]
    assert overrun.cycle("wave", LONG) == (Flag.MISSED, 0)
    assert overrun.cycle("wave", LONG + 2) == (Flag.SKIPPED, 1)
    assert overrun.lost("wave", LONG) == (1, 1)
    assert overrun.ticks("late", "wave", LONG, end_of(LONG)) == [LONG + 1]
    assert overrun.ticks("starved", "wave", LONG, end_of(LONG)) == []
    both = [overrun.lost("wave", fault["tick"]) for fault in FAULTS]
    assert overrun.blocks["wave"][:2] == [sum(counts) for counts in zip(*both, strict=True)]


def test_runs_with_overruns_repeat(config: MakeConfig, overrun: Ran) -> None:
    assert run_faults(config(), *FAULTS).digest == overrun.digest


@pytest.mark.slow
@pytest.mark.parametrize(("first", "missed", "late"), [(BELOW, 0, []), (EXACT, 1, [EXACT + 1])])
def test_computing_must_end_before_the_deadline(
    overrun: Ran, first: int, missed: int, late: list[int]
) -> None:
    assert overrun.lost("wave", first)[0] == missed
    assert overrun.ticks("late", "wave", first, end_of(first)) == late
    assert overrun.visible("wave.status", first) == first + 1 + missed


@pytest.mark.slow
def test_lateness_is_carried_from_cycle_to_cycle(overrun: Ran) -> None:
    # Cycles of 1.5 ticks that follow each other: 0.0, 1.5, 3.0, 4.5, and the rest in time.
    ticks = overrun.written.cycles["wave"]["tick"] - CARRIED
    assert ticks[ticks >= 0][:6].tolist() == [0, 1, 3, 4, 6, 7]
    assert overrun.lost("wave", CARRIED) == (4, 2)


@pytest.mark.slow
def test_a_task_that_misses_four_releases_is_starved_and_not_restarted(overrun: Ran) -> None:
    assert overrun.ticks("late", "wave", STARVED, end_of(STARVED)) == [STARVED + 1]
    assert overrun.ticks("starved", "wave", STARVED, end_of(STARVED)) == [STARVED + 4]
    assert overrun.cycle("wave", STARVED + 20) == (Flag.SKIPPED, 19)
    assert not [event for event in overrun.events if event.kind in ("loss", "restart")]


@pytest.mark.slow
def test_a_cycle_of_several_ticks_ends_in_the_middle_of_a_later_one(overrun: Ran) -> None:
    # Its period is 8 ticks: it computes for 12.
    assert overrun.visible("watch.status", WATCH) == WATCH + 16
    assert overrun.cycle("watch", WATCH) == (Flag.MISSED, 0)
    assert overrun.ticks("late", "watch") == [WATCH + 8]
    assert overrun.blocks["watch"][:2] == [1, 0]


@pytest.mark.slow
def test_a_slow_plan_is_late(overrun: Ran) -> None:
    # A plan has four ticks, and this one takes half a tick more.
    assert overrun.cycle("wave.planner", PLAN) == (Flag.MISSED, 0)
    assert overrun.visible("wave.plan", PLAN) == PLAN + 5
    assert overrun.ticks("plan_late", "wave.planner", PLAN, end_of(PLAN)) == [PLAN + 4]
    assert overrun.lost("wave.planner", PLAN)[0] == 1
    assert overrun.lost("wave", PLAN) == (0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["double-buffer", "lock"])
def test_a_message_that_shows_at_once_shows_when_the_computing_ends(
    config: MakeConfig, protocol: str
) -> None:
    setting = f"protocol.mailbox={{ 'watch.status' = '{protocol}' }}"
    found = run(config, setting, kind="overrun", board="watch", cycles=1, by=0.5)
    assert found.visible("watch.status", FIRST) == FIRST + 4
    assert found.visible("watch.status", FIRST + 8) == FIRST + 8
    assert found.blocks["watch"][:2] == [0, 0]


@pytest.mark.slow
def test_a_task_that_is_late_at_the_end_of_the_run_ends(config: MakeConfig) -> None:
    found = run(config, kind="overrun", board="wave", by=90.0)
    # It then still takes the last release, as a task does that is late in real time.
    ticks = found.written.cycles["wave"]["tick"]
    assert ticks[ticks >= FIRST].tolist() == [FIRST, 99]
    assert found.blocks["wave"][0] == 2


@pytest.mark.slow
def test_a_hog_stops_the_tasks_of_its_core_up_to_its_priority(config: MakeConfig) -> None:
    priorities = ("board.wave.priority=50", "board.wave.planner_priority=20", "board.watch.core=0")
    found = run(config, *priorities, kind="hog", board="wave", cycles=6)
    # The release at the end of the fault is the next that they take.
    assert found.cycle("wave", FIRST + 6) == (Flag.SKIPPED, 6)
    assert found.blocks["wave"][:2] == [0, 6]
    assert found.ticks("late", "wave") == [FIRST + 1]
    assert found.ticks("starved", "wave") == [FIRST + 4]
    assert found.ticks("plan_late", "wave.planner") == [FIRST + 1]
    assert found.blocks["watch"][:2] == [0, 0]
    lower = run(config, *priorities, kind="hog", board="wave.planner", cycles=2)
    assert lower.blocks["wave"][:2] == [0, 0]
    assert lower.ticks("starved", "wave.planner") == [FIRST + 4]


@pytest.mark.slow
@pytest.mark.parametrize(("late", "alarms"), [(0.9, [FIRST]), (0.4, [])])
def test_late_ticks_are_found_by_the_fastest_task(
    config: MakeConfig, late: float, alarms: list[int]
) -> None:
    found = run(config, kind="clock-jitter", board="clock", late=late, least=late, **{"for": 0.05})
    assert [event.tick for event in found.events if event.code == "clock_late"] == alarms
    assert all(event.board == "wave" for event in found.events if event.code == "clock_late")
    rows = found.written.cycles["wave"]
    is_late = (rows["tick"] >= FIRST) & (rows["tick"] < FIRST + 20)
    lateness = rows["start_ns"] - rows["release_ns"]
    assert lateness[is_late].tolist() == [round(late * 2_500_000)] * 20
    assert not lateness[~is_late].any()
    assert found.blocks["wave"][:2] == [0, 0]


@pytest.mark.slow
def test_lateness_of_a_tick_adds_to_the_computing(config: MakeConfig) -> None:
    # Late by 0.6 and computing for 0.5 ticks, a cycle misses its deadline.
    jitter = {"kind": "clock-jitter", "board": "clock", "late": 0.6, "least": 0.6}
    found = run_faults(config(), jitter, {**WAVE, "tick": FIRST, "by": 0.5}, seconds=SECONDS)
    assert found.blocks["wave"][0] == 1
