"""Times of snapshots: within a share of lockstep's time, periodically, and at a requested tick."""

from __future__ import annotations

import errno
import os
import time
from pathlib import Path
from socket import socketpair
from time import process_time_ns
from types import SimpleNamespace

import pytest

from rack.backplane.process import busy_wait_until, name_process
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.errors import SnapshotError
from rack.boards.run.copying import Copier
from rack.boards.run.snapshots import ClockCopies
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus, make_bus  # noqa: F401  a fixture

PART = 20
COST_NS = 2_000_000


class StubCopier:
    """Stands for a fork: takes some time, and notes the tick."""

    def __init__(self) -> None:
        self.ticks: list[int] = []

    def fork_copy(self, tick: int, memory: int) -> None:
        """Take time."""
        busy_wait_until(process_time_ns() + COST_NS)
        self.ticks.append(tick)


@pytest.fixture
def segment(make_bus: MakeBus) -> Segment:  # noqa: F811
    return make_bus(task("level"))


def copies_of(segment: Segment) -> tuple[ClockCopies, StubCopier]:
    copier = StubCopier()
    # No task is there to fork.
    driver = SimpleNamespace(tasks=(), wait_until_settled=lambda: None)
    return ClockCopies(segment, driver, copier), copier  # type: ignore[arg-type]


def test_snapshots_take_a_limited_share_of_the_time(segment: Segment) -> None:
    segment.words[System.SNAPSHOT_PART] = PART
    copies, copier = copies_of(segment)
    started_s = time.monotonic()
    costs_s: list[float] = []
    tick = 0
    while len(copier.ticks) < 4:
        taken = len(copier.ticks)
        copies(tick)
        if len(copier.ticks) > taken:
            elapsed_s = time.monotonic() - started_s - copies.cost_s
            assert sum(costs_s) * PART <= elapsed_s
            costs_s.append(copies.cost_s)
        tick += 1
    assert min(costs_s) >= COST_NS * 1e-9
    assert copier.ticks[0] == 0


def test_snapshots_are_taken_periodically_and_before_the_requested_tick(
    segment: Segment,
) -> None:
    segment.words[System.SNAPSHOT_EVERY] = 30
    segment.words[System.SNAPSHOT_AT] = 50 + 1
    copies, copier = copies_of(segment)
    tick = 0
    while tick <= 100:
        # No batch goes beyond what it returns.
        tick = min(copies(tick), tick + 8)
    assert copier.ticks == [0, 30, 50, 80]


def test_no_snapshot_is_taken_without_a_request(segment: Segment) -> None:
    copies, copier = copies_of(segment)
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
