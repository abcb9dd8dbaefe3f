"""Faults put into a rack while it runs, on its memory alone: the test is its clock."""

from __future__ import annotations

import pytest

from rack.backplane.fault_table import NEVER, FaultTable, Stage
from rack.backplane.segment import Segment
from rack.backplane.words import Run, System
from rack.boards.config import RackConfig
from rack.tools.console.answer import Failure
from rack.tools.faults import live
from rack.tools.faults.live import LiveRack
from tests.processes import in_thread, wait_until
from tests.tools.conftest import MakeSegment

TICK = 100


class Running:
    """A rack that runs, as far as its memory says; `live` is a look at it."""

    def __init__(self, segment: Segment) -> None:
        self.segment = segment
        segment.words[System.STATE] = Run.RUNNING
        segment.words[System.TICK] = TICK
        self.table = FaultTable(segment)
        self.live = LiveRack(segment)

    def begin(self, until: int = TICK + 9) -> None:
        """Begin the first fault, as the clock does."""
        entry = self.table.entries[0]
        entry.tick = TICK + 1
        entry.until = until
        entry.stage = Stage.ACTIVE

    def serve(self, acted: int = 0) -> None:
        """Begin the first fault as soon as it waits, and end it if it is to act."""
        entry = self.table.entries[0]
        wait_until(lambda: entry.stage == Stage.WAITING)
        self.begin()
        if acted:
            entry.count = acted
            entry.stage = Stage.OVER


@pytest.fixture
def rack(config: RackConfig, make_segment: MakeSegment) -> Running:
    return Running(make_segment(config))


def test_a_fault_that_begins_at_the_next_tick_is_waited_for(rack: Running) -> None:
    drop = {"board": "lower", "kind": "drop", "probability": "0.5"}
    with in_thread(rack.serve):
        found = rack.live.inject_fault(drop, False)
    assert (found["fault"], found["stage"], found["waits_for"]) == (0, "active", "")
    assert found["message"].endswith(f": from tick {TICK + 1} to tick {TICK + 8}")
    rack.begin(NEVER)
    assert rack.live._describe_state(rack.table.entries[0]).endswith("to the end of the run")


@pytest.mark.parametrize(("acted", "text"), [(1, "acted once"), (3, "acted 3 times")])
def test_a_fault_that_is_over_says_when_it_acted(rack: Running, acted: int, text: str) -> None:
    mute = {"board": "lower", "kind": "mute", "cycles": "4"}
    with in_thread(lambda: rack.serve(acted)):
        found = rack.live.inject_fault(mute, True, 20.0)
    assert found["stage"] == "over"
    assert found["message"].endswith(f": ticks {TICK + 1} to {TICK + 8}, {text}")


def test_a_fault_with_a_future_tick_is_armed_and_can_be_withdrawn(rack: Running) -> None:
    found = rack.live.inject_fault({"board": "lower", "kind": "kill", "tick": TICK + 1}, False)
    assert found["stage"] == "waiting"
    assert found["waits_for"] == f"tick {TICK + 1}; the rack is at tick {TICK}"
    hint = f"to withdraw it: rack inject {rack.segment.rack} --withdraw 0"
    assert found["message"].endswith(f"armed, waits for {found['waits_for']}; {hint}")
    with pytest.raises(Failure, match="fault 1 is not waiting; waiting: 0"):
        rack.live.withdraw_fault(1)
    ticks = iter((TICK + 1, TICK + 2))

    def tick() -> None:
        wait_until(lambda: rack.table.entries[0].tick == NEVER)
        for now in ticks:
            rack.segment.words[System.TICK] = now

    with in_thread(tick):
        withdrawn = rack.live.withdraw_fault(0)
    assert (withdrawn["stage"], withdrawn["message"]) == ("free", f"{found['text']}: withdrawn")
    assert rack.live.list_faults() == []
    with pytest.raises(Failure, match="fault 0 is not waiting; waiting: none"):
        rack.live.withdraw_fault(0)


def test_a_fault_that_begins_while_it_is_withdrawn_stays(rack: Running) -> None:
    rack.live.inject_fault({"board": "lower", "kind": "kill", "tick": TICK + 1}, False)

    def begin() -> None:
        wait_until(lambda: rack.table.entries[0].tick == NEVER)
        rack.begin()
        rack.segment.words[System.TICK] = TICK + 2

    with (
        in_thread(begin),
        pytest.raises(Failure, match="it had begun before it could be withdrawn"),
    ):
        rack.live.withdraw_fault(0)


@pytest.mark.timeout(60)
def test_a_fault_is_withdrawn_at_once_from_a_held_rack(
    rack: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "BEGIN_S", 1000.0)
    rack.live.inject_fault({"board": "lower", "kind": "kill", "tick": TICK + 50}, False)
    rack.segment.words[System.HELD] = TICK
    assert rack.live.withdraw_fault(0)["stage"] == "free"


def test_every_wait_ends(rack: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "BEGIN_S", 0.02)
    with pytest.raises(Failure, match=r"the clock has not begun it within 0\.02 s"):
        rack.live.inject_fault({"board": "lower", "kind": "kill"}, False)
    later = {"board": "lower", "kind": "kill", "tick": TICK + 50}
    with pytest.raises(Failure, match=r"timed out after 0\.02 s: .* armed"):
        rack.live.inject_fault(later, True, 0.02)

    def stop() -> None:
        wait_until(lambda: len(rack.table.list_entries((Stage.WAITING,))) == 3)
        rack.segment.words[System.STATE] = Run.STOPPED

    with in_thread(stop), pytest.raises(Failure, match="the run ended before it began"):
        rack.live.inject_fault(later, True)
    with pytest.raises(Failure, match=f"rack '{rack.segment.rack}': its run is over"):
        rack.live.inject_fault(later, False)
