"""The snapshots of a crate are bounded in number and memory, and thinned out with age."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise

import pytest

from rack.boards.crate import shelf as module
from rack.boards.crate.shelf import HeldSnapshot, SnapshotShelf
from tests.processes import descriptors

SIZE = 4096


@pytest.fixture
def shelf() -> Iterator[SnapshotShelf]:
    before = descriptors()
    shelf = SnapshotShelf()
    yield shelf
    shelf.drop_all()
    with closing(shelf.line), closing(shelf.boards_line):
        pass
    assert descriptors() == before


def hold(shelf: SnapshotShelf, tick: int) -> None:
    """Hold a snapshot of a rack without processes."""
    memory = os.memfd_create("test")
    os.ftruncate(memory, SIZE)
    shelf._add_complete_snapshot(HeldSnapshot(tick, memory=memory))


def ticks(shelf: SnapshotShelf) -> list[int]:
    return sorted(snapshot.tick for snapshot in shelf._complete_snapshots)


def test_the_nearest_snapshot_before_a_tick_is_found(shelf: SnapshotShelf) -> None:
    for tick in (0, 100, 50):
        hold(shelf, tick)
    found = [shelf.find_nearest(tick) for tick in (0, 49, 50, 99, 1000)]
    assert [one and one.tick for one in found] == [0, 0, 50, 50, 100]
    assert shelf.find_nearest(-1) is None


def test_the_first_and_newest_snapshots_stay_and_older_ones_are_thinned_out(
    shelf: SnapshotShelf,
) -> None:
    for tick in range(0, 1000, 10):
        hold(shelf, tick)
    kept = ticks(shelf)
    assert len(kept) == len(shelf) == module.MOST_SNAPSHOTS
    assert (kept[0], kept[-1]) == (0, 990)
    gaps = [after - before for before, after in pairwise(kept)]
    middle = len(gaps) // 2
    assert min(gaps[:middle]) > max(gaps[-middle // 2 :])


def test_the_memory_of_all_snapshots_is_bounded(
    shelf: SnapshotShelf, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shelf, "_most_bytes", 5 * SIZE)
    for tick in range(0, 1000, 10):
        hold(shelf, tick)
        assert shelf.private_bytes <= 5 * SIZE
    assert ticks(shelf)[0] == 0
    assert len(shelf) == 5


def test_a_snapshot_replaces_one_of_the_same_tick(shelf: SnapshotShelf) -> None:
    hold(shelf, 7)
    hold(shelf, 7)
    assert ticks(shelf) == [7]
