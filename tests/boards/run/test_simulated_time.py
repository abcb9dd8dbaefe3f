"""Computing that takes simulated time in lockstep: late outputs, missed releases, alarms."""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest

from rack.backplane.trace import SKIPPED_SHIFT, Flag
from rack.backplane.words import Block
from rack.boards import Rack
from rack.boards.events import Event
from tests.boards.conftest import MakeConfig
from tests.boards.messages import Written
from tests.boards.runs import faulty

SECONDS = 0.25
FIRST = 40


class Ran(NamedTuple):
    """A run with one fault."""

    digest: str
    written: Written
    events: tuple[Event, ...]
    blocks: dict[str, list[int]]

    def ticks(self, code: str, board: str) -> list[int]:
        """Return the ticks of the events of a kind about a board."""
        return [event.tick for event in self.events if (event.code, event.subject) == (code, board)]

    def cycle(self, task: str, tick: int) -> tuple[Flag, int]:
        """Return the flags of a cycle, and the number of releases skipped before it."""
        rows = self.written.cycles[task]
        flags = int(rows["flags"][rows["tick"] == tick][0])
        low = (1 << SKIPPED_SHIFT) - 1
        return Flag(flags & low) & (Flag.MISSED | Flag.SKIPPED), flags >> SKIPPED_SHIFT

    def visible(self, mailbox: str, tick: int) -> int:
        """Return the tick at which the message of a cycle is visible."""
        rows = self.written.messages[mailbox]
        return int(rows["visible_at"][rows["tick"] == tick][0])


def run(config: MakeConfig, *settings: str, **fault: Any) -> Ran:
    """Run the rack of the waves with one fault from tick `FIRST` on."""
    with Rack(faulty(config(*settings), {"tick": FIRST, **fault})) as rack:
        digest = rack.run(SECONDS).digest
        words = (Block.MISSED, Block.SKIPPED, Block.PLANS)
        blocks = {
            task.name: [rack.segment.get_block(task.name)[word] for word in words]
            for task in rack.segment.layout.tasks
        }
        return Ran(digest, Written.on(rack.segment), tuple(rack.events), blocks)


def test_an_overrun_shows_its_messages_late_and_skips_releases(config: MakeConfig) -> None:
    found = run(config, kind="overrun", board="wave", cycles=1, by=2.5)
    # It computes until the middle of tick 42, and then begins late with the release at 42.
    assert found.visible("wave.status", FIRST) == FIRST + 3
    assert FIRST + 1 not in found.written.cycles["wave"]["tick"]
    assert found.cycle("wave", FIRST) == (Flag.MISSED, 0)
    assert found.cycle("wave", FIRST + 2) == (Flag.SKIPPED, 1)
    assert found.blocks["wave"][:2] == [1, 1]
    assert found.ticks("late", "wave") == [FIRST + 1]
    assert found.ticks("starved", "wave") == []
    assert run(config, kind="overrun", board="wave", cycles=1, by=2.5).digest == found.digest


@pytest.mark.slow
@pytest.mark.parametrize(("by", "missed", "late"), [(0.9, 0, []), (1.0, 1, [FIRST + 1])])
def test_computing_must_end_before_the_deadline(
    config: MakeConfig, by: float, missed: int, late: list[int]
) -> None:
    found = run(config, kind="overrun", board="wave", cycles=1, by=by)
    assert found.blocks["wave"][0] == missed
    assert found.ticks("late", "wave") == late
    assert found.visible("wave.status", FIRST) == FIRST + 1 + missed


@pytest.mark.slow
def test_lateness_is_carried_from_cycle_to_cycle(config: MakeConfig) -> None:
    found = run(config, kind="overrun", board="wave", cycles=6, by=1.5)
    # Cycles of 1.5 ticks that follow each other: 40.0, 41.5, 43.0, 44.5, and the rest in time.
    ticks = found.written.cycles["wave"]["tick"]
    assert ticks[ticks >= FIRST][:6].tolist() == [40, 41, 43, 44, 46, 47]
    assert found.blocks["wave"][:2] == [4, 2]


@pytest.mark.slow
def test_a_task_that_misses_four_releases_is_starved_and_not_restarted(config: MakeConfig) -> None:
    found = run(config, kind="overrun", board="wave", cycles=1, by=20.0)
    assert found.ticks("late", "wave") == [FIRST + 1]
    assert found.ticks("starved", "wave") == [FIRST + 4]
    assert found.cycle("wave", FIRST + 20) == (Flag.SKIPPED, 19)
    assert not [event for event in found.events if event.kind in ("loss", "restart")]


@pytest.mark.slow
def test_a_cycle_of_several_ticks_ends_in_the_middle_of_a_later_one(config: MakeConfig) -> None:
    found = run(config, kind="overrun", board="watch", cycles=1, by=1.5)
    # Its period is 8 ticks: it computes from 40 to 52.
    assert found.visible("watch.status", FIRST) == FIRST + 16
    assert found.cycle("watch", FIRST) == (Flag.MISSED, 0)
    assert found.ticks("late", "watch") == [FIRST + 8]
    assert found.blocks["watch"][:2] == [1, 0]


@pytest.mark.slow
def test_a_slow_plan_is_late(config: MakeConfig) -> None:
    found = run(config, kind="planner-slow", board="wave.planner", cycles=1, by=0.5)
    # A plan has four ticks, and this one takes half a tick more.
    assert found.cycle("wave.planner", FIRST) == (Flag.MISSED, 0)
    assert found.visible("wave.plan", FIRST) == FIRST + 5
    assert found.ticks("plan_late", "wave.planner") == [FIRST + 4]
    assert found.blocks["wave.planner"][0] == 1
    assert found.blocks["wave"][:2] == [0, 0]


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
    with Rack(
        faulty(
            config(),
            {"kind": "clock-jitter", "board": "clock", "late": 0.6, "least": 0.6},
            {"kind": "overrun", "board": "wave", "tick": FIRST, "cycles": 1, "by": 0.5},
        )
    ) as rack:
        rack.run(SECONDS)
        assert rack.segment.get_block("wave")[Block.MISSED] == 1
