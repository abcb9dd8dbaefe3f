"""Times of snapshots: within a share of lockstep's time, periodically, and at a requested tick."""

from __future__ import annotations

import errno
import os
from itertools import pairwise
from pathlib import Path
from socket import socketpair
from types import SimpleNamespace

import pytest

from rack.backplane.process import name_process
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.errors import SnapshotError
from rack.boards.run import snapshots
from rack.boards.run.copying import Copier
from rack.boards.run.snapshots import ClockCopies
from rack.boards.wiring import SnapshotPolicy
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus

PART = 20
MOST_COST = 0.03
"""Largest share of lockstep's time that snapshots may cost."""
COST_PER_STANDSTILL = 2.0
"""Measured with nasrem: with the memory pages that are copied afterwards, a snapshot costs twice
the time for which it stops the rack."""


class StubCopier:
    """Stands for a fork: takes `cost_s` of a simulated time, and notes the tick."""

    def __init__(self) -> None:
        self.ticks: list[int] = []
        self.now_s = 5.0
        self.cost_s = 0.0

    def fork_copy(self, tick: int, memory: int) -> None:
        """Take time."""
        self.now_s += self.cost_s
        self.ticks.append(tick)


@pytest.fixture
def segment(make_bus: MakeBus) -> Segment:
    return make_bus(task("level"))


def copies_of(segment: Segment, copier: StubCopier) -> ClockCopies:
    # No task is there to fork.
    driver = SimpleNamespace(tasks=(), wait_until_settled=lambda: None)
    return ClockCopies(segment, driver, copier)  # type: ignore[arg-type]


@pytest.mark.parametrize("cost_s", [0.004, 0.02, 0.15])
def test_snapshots_take_a_limited_share_of_the_time(
    segment: Segment, monkeypatch: pytest.MonkeyPatch, cost_s: float
) -> None:
    copier = StubCopier()
    monkeypatch.setattr(snapshots, "time", SimpleNamespace(monotonic=lambda: copier.now_s))
    segment.words[System.SNAPSHOT_PART] = PART
    copies = copies_of(segment, copier)
    taken_at_s = [copier.now_s]
    # From the third snapshot on, they cost twice as much.
    tick = 0
    while True:
        copier.cost_s = cost_s * (2.0 if len(copier.ticks) > 2 else 1.0)
        taken = len(copier.ticks)
        tick = copies(tick)
        if len(copier.ticks) > taken:
            taken_at_s.append(copier.now_s)
        if len(copier.ticks) == 6:
            break
        copier.now_s += 0.001
    spacings_s = [later - earlier for earlier, later in pairwise(taken_at_s)]
    # Before the first one is measured, its cost is assumed.
    expected_s = [snapshots.FIRST_COST_S * PART + cost_s, *[cost_s * (PART + 1)] * 2]
    expected_s += [cost_s * (PART + 2), *[2.0 * cost_s * (PART + 1)] * 2]
    # A snapshot comes as soon as its cost permits.
    assert spacings_s == pytest.approx(expected_s, abs=0.0021)


def test_the_default_spacing_keeps_the_cost_of_snapshots_below_its_limit() -> None:
    assert COST_PER_STANDSTILL / SnapshotPolicy().part <= MOST_COST


def test_snapshots_are_taken_periodically_and_before_the_requested_tick(
    segment: Segment,
) -> None:
    segment.words[System.SNAPSHOT_EVERY] = 30
    segment.words[System.SNAPSHOT_AT] = 50 + 1
    copier = StubCopier()
    copies = copies_of(segment, copier)
    tick = 0
    while tick <= 100:
        # No batch goes beyond what it returns.
        tick = min(copies(tick), tick + 8)
    assert copier.ticks == [0, 30, 50, 80]


def test_no_snapshot_is_taken_without_a_request(segment: Segment) -> None:
    copier = StubCopier()
    copies = copies_of(segment, copier)
    assert min(copies(tick) for tick in range(50)) > 1 << 60
    assert copier.ticks == []


def test_a_copy_has_its_own_name_before_it_runs(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    comm = Path("/proc/self/task", str(os.getpid()), "comm")
    before, seen = comm.read_text(), list[str]()

    def refuse() -> int:
        seen.append(comm.read_text().strip())
        raise OSError(errno.EAGAIN, "no more processes")

    monkeypatch.setattr(Copier, "_list_obstacles", lambda self, memory: [])
    monkeypatch.setattr(os, "fork", refuse)
    here, there = socketpair()
    with here, there, pytest.raises(SnapshotError, match="level: cannot be copied: no more"):
        Copier(segment, "level", there).fork_copy(3)
    seen.append(comm.read_text().strip())
    name_process(before.strip())
    # A copy has the name that its parent has at the fork.
    assert seen == ["copy:level", f"{segment.rack}:level"[:15]]
