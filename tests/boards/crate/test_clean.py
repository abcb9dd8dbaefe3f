"""Removal of what killed racks left: never a rack in use, and never twice."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rack.backplane.byte_lock import ByteLock
from rack.backplane.errors import RackInUseError, SegmentError
from rack.backplane.layout import Layout
from rack.backplane.segment import (
    SHM_FOLDER,
    Segment,
    get_shm_path,
    list_racks,
    unlink_segment,
)
from rack.backplane.words import Head, System
from rack.boards.crate.clean import remove_dead_rack, remove_dead_racks, remove_own_racks
from tests.backplane.bus import layout, mailbox
from tests.processes import FORKS, exit_status, fork, kill, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)
STRANGER = 65_533
as_root = pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")


@pytest.fixture
def spec(rack_name: str) -> Iterator[Layout]:
    """A layout; whatever is made of it is removed."""
    yield layout(rack_name, [mailbox("lock")])
    unlink_segment(rack_name)


def leave_dead(spec: Layout) -> None:
    """Leave a segment as a launcher that was killed would."""

    def launch() -> None:
        Segment.create(spec, "")

    assert exit_status(fork(launch)) == 0


def left(rack: str) -> list[str]:
    return [path.name for path in SHM_FOLDER.iterdir() if rack in path.name]


def test_a_dead_racks_segment_is_removed(spec: Layout) -> None:
    leave_dead(spec)
    assert len(left(spec.rack)) == 1
    assert remove_dead_rack(spec.rack)
    assert left(spec.rack) == []


def test_a_live_rack_is_refused_with_its_launcher(spec: Layout) -> None:
    segment = Segment.create(spec, "")
    with pytest.raises(
        SegmentError,
        match=f"rack '{spec.rack}' is already running, launched by process {os.getpid()}",
    ):
        remove_dead_rack(spec.rack)
    assert segment.is_named
    segment.close()


@pytest.mark.parametrize("size", [0, 100, 8192])
def test_a_file_too_small_for_a_segment_is_removed(rack_name: str, size: int) -> None:
    get_shm_path(rack_name).write_bytes(bytes(size))
    assert remove_dead_rack(rack_name)
    assert rack_name not in list_racks()


@as_root
def test_another_users_rack_is_left_alone(spec: Layout) -> None:
    leave_dead(spec)

    def remove() -> None:
        os.setuid(STRANGER)
        with pytest.raises(SegmentError, match="belongs to another user"):
            remove_dead_rack(spec.rack)
        removed, in_use, strange = remove_dead_racks()
        assert spec.rack not in removed + in_use
        assert any(line.startswith(f"rack '{spec.rack}' belongs to another") for line in strange)

    assert exit_status(fork(remove)) == 0
    assert spec.rack in list_racks()


def test_a_rack_removed_and_launched_meanwhile_is_not_removed(
    spec: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_dead(spec)
    found = Segment.open(spec.rack)
    assert remove_dead_rack(spec.rack)
    again = Segment.create(spec, "")
    # Who has looked before all that finds a dead rack still.
    monkeypatch.setattr(Segment, "open", lambda rack: found)
    assert not remove_dead_rack(spec.rack)
    assert again.is_named
    again.close()


def test_a_rack_relaunched_during_the_check_is_not_removed(
    spec: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_dead(spec)
    anew = []
    look = Segment.open

    def overtaken(rack: str) -> Segment:
        unlink_segment(rack)
        try:
            return look(rack)
        finally:
            anew.append(Segment.create(spec, ""))

    monkeypatch.setattr(Segment, "open", overtaken)
    with pytest.raises(SegmentError):
        remove_dead_rack(spec.rack)
    assert anew[0].is_named
    anew[0].close()


def test_a_removal_under_way_is_left_alone(spec: Layout) -> None:
    leave_dead(spec)
    found = Segment.open(spec.rack)
    other = ByteLock(found.fd, 8 * Head.MAGIC)
    assert other.take()
    assert not remove_dead_rack(spec.rack)
    assert found.is_named
    other.close()
    assert remove_dead_rack(spec.rack)
    found.close()


def contend(spec: Layout, start: Segment, word: int) -> bool:
    """Launch as others do: remove what is dead, take the name; keep it until killed."""
    start.words[word] = 1
    while not start.words[System.TICK]:
        pass
    try:
        remove_dead_rack(spec.rack)
        segment = Segment.create(spec, "")
    except SegmentError:
        start.words[word] = 2
        return False
    start.words[word] = 3 if segment.is_named else 4
    time.sleep(60)
    return True


@pytest.mark.slow
@pytest.mark.parametrize("trial", range(4))
def test_one_of_several_launches_takes_and_keeps_a_dead_racks_name(
    spec: Layout, rack_name: str, trial: int
) -> None:
    leave_dead(spec)
    start = Segment.create(layout(f"{rack_name}-start"), "")
    words = [300, 301, 302, 303]
    launchers = [fork(lambda word=word: contend(spec, start, word)) for word in words]
    try:
        wait_until(lambda: all(start.words[word] == 1 for word in words))
        start.words[System.TICK] = 1
        wait_until(lambda: all(start.words[word] > 1 for word in words))
        assert sorted(start.words[word] for word in words) == [2, 2, 2, 3]
        winner = launchers[[start.words[word] for word in words].index(3)]
        found = Segment.attach(spec.rack)
        assert found.launcher == winner
        found.close()
    finally:
        for pid in launchers:
            kill(pid)
        unlink_segment(start.rack)
        start.close()


@pytest.mark.parametrize("kind", ["directory", "symbolic link"])
def test_a_foreign_entry_is_named_and_left_alone(rack_name: str, tmp_path: Path, kind: str) -> None:
    place, target = get_shm_path(rack_name), tmp_path / "target"
    target.write_bytes(bytes(8192))
    place.mkdir() if kind == "directory" else place.symlink_to(target)
    why = f"rack '{rack_name}': {place} is a {kind}, not a segment"
    try:
        assert why in remove_dead_racks()[2]
        with pytest.raises(SegmentError, match=re.escape(why)):
            remove_dead_rack(rack_name)
        with pytest.raises(SegmentError, match=re.escape(why)):
            Segment.attach(rack_name)
        assert place.is_dir() if kind == "directory" else place.is_symlink()
        assert target.read_bytes() == bytes(8192)
    finally:
        place.rmdir() if kind == "directory" else place.unlink()


def test_a_rack_of_another_pid_namespace_is_not_mistaken_for_ones_own(spec: Layout) -> None:
    # Every container has a process 1.
    segment = Segment.create(spec, "")
    segment.words[Head.LAUNCHER_NAMESPACE] += 1
    remove_own_racks(spec.rack, killed=[os.getpid()])
    assert segment.is_named
    with pytest.raises(RackInUseError, match="launched by a process of another PID namespace"):
        remove_dead_rack(spec.rack)
    segment.close()


def test_a_process_removes_only_the_racks_that_it_launched(spec: Layout, rack_name: str) -> None:
    own = Segment.create(spec, "")
    other = layout(f"{rack_name}-other")
    assert exit_status(fork(lambda: Segment.create(other, "").close())) == 0
    try:
        remove_own_racks()
        assert left(spec.rack) == [get_shm_path(other.rack).name]
        remove_own_racks(killed=[Segment.open(other.rack).launcher])
        assert left(spec.rack) == []
    finally:
        unlink_segment(other.rack)
        own.close()
