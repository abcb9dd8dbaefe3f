"""The segment: attaching, its contents, and no name before it is complete."""

from __future__ import annotations

import os
import random
import signal
import stat
import time
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from rack.backplane.errors import SegmentError
from rack.backplane.segment import VERSION, Segment, get_shm_path, list_racks, unlink_segment
from rack.backplane.words import Block, Head, System
from tests.backplane.bus import layout, mailbox, task
from tests.backplane.conftest import MakeBus
from tests.processes import (
    BOUND_S,
    FORKS,
    descriptors,
    exit_status,
    fork,
    forked,
    in_thread,
    kill,
    runs,
)

pytestmark = pytest.mark.filterwarnings(FORKS)
STRANGER, ANOTHER = 65_533, 65_532
"""Users that own nothing here."""
as_root = pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")


def refusal(attach: Callable[[], object]) -> str:
    with pytest.raises(SegmentError) as error:
        attach()
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_segment_is_private_to_its_user_and_fully_allocated(make_bus: MakeBus) -> None:
    segment = make_bus(mailbox())
    found = get_shm_path(segment.rack).stat()
    assert stat.S_IMODE(found.st_mode) == 0o600
    assert found.st_size == len(segment.bytes)
    assert found.st_blocks * 512 >= found.st_size


def test_attached_processes_find_layout_config_and_the_same_memory(make_bus: MakeBus) -> None:
    made = make_bus(mailbox(), mailbox("lock", name="writer.other"), config='name = "näme"\n')
    found = Segment.attach(made.rack)
    assert found.layout == made.layout
    assert found.config == made.config
    assert found.map.mailboxes == made.map.mailboxes
    assert (found.launcher, found.launcher_is_alive) == (os.getpid(), True)
    made.words[System.TICK] = 2**62 + 1
    found.get_block("reader")[Block.DONE] = -7
    assert found.words[System.TICK] == 2**62 + 1
    assert made.get_block("reader")[Block.DONE] == -7


def test_tasks_begin_without_a_release_and_boards_hold_sysfail(make_bus: MakeBus) -> None:
    segment = make_bus()
    assert [
        segment.get_block(t)[w] for t in ("writer", "reader") for w in (Block.RELEASED, Block.DONE)
    ] == [-1] * 4
    assert [segment.words[System.SYSFAIL + slot] for slot in (1, 2, 3, 4)] == [0, 1, 1, 0]


@pytest.mark.parametrize(
    ("deadline", "tick", "skipped"),
    [(8, 7, 0), (8, 8, 1), (8, 12, 2), (40, 39, 0), (40, 40, 9)],
    ids=["in time", "late", "lost", "planning", "plan late"],
)
def test_an_unfinished_release_is_skipped_unless_its_plan_is_in_time(
    make_bus: MakeBus, deadline: int, tick: int, skipped: int
) -> None:
    spec = task("writer", every=4)
    segment = make_bus(spec)
    block = segment.get_block(spec.name)
    block[Block.DONE], block[Block.RELEASED], block[Block.DEADLINE] = 0, 4, deadline
    assert segment.count_cycles(spec, tick).skipped == skipped


def test_a_name_in_use_is_refused_and_the_first_segment_stays(make_bus: MakeBus) -> None:
    first = make_bus()
    first.words[System.TICK] = 5
    assert f"rack '{first.rack}' already has a segment" in refusal(
        lambda: Segment.create(first.layout, "")
    )
    assert Segment.attach(first.rack).words[System.TICK] == 5


@pytest.mark.parametrize("name", ["nobody-s", "a/b", "x" * 300])
def test_attaching_to_an_unknown_rack_names_the_racks(make_bus: MakeBus, name: str) -> None:
    there = make_bus().rack
    message = refusal(lambda: Segment.attach(name))
    assert f"rack '{name}' does not exist" in message
    assert there in message


def raise_version(segment: Segment) -> str:
    segment.words[Head.VERSION] = VERSION + 1
    return f"layout version {VERSION + 1}; this program attaches to {VERSION}"


def change_kind(segment: Segment) -> str:
    segment.words[Head.MAGIC] += 1
    return segment.rack


def rename_field(segment: Segment) -> str:
    start = segment.words[Head.LAYOUT_AT]
    text = bytes(segment.bytes[start : start + segment.words[Head.LAYOUT_SIZE]])
    segment.bytes[start : start + len(text)] = text.replace(b'"wake"', b'"woke"')
    return "the layout is damaged or from another program"


def lengthen(segment: Segment) -> str:
    size = len(segment.bytes)
    os.truncate(get_shm_path(segment.rack), size + 4096)
    return f"the segment has {size + 4096} bytes, but its head says {size}"


@pytest.mark.parametrize("change", [raise_version, change_kind, rename_field, lengthen])
def test_a_segment_that_this_program_does_not_understand_is_refused(
    make_bus: MakeBus, change: Callable[[Segment], str]
) -> None:
    segment = make_bus()
    why, before = change(segment), descriptors()
    for _ in range(2):
        assert why in refusal(lambda: Segment.attach(segment.rack))
    assert descriptors() == before


def test_a_segment_without_room_for_a_head_is_refused(rack_name: str) -> None:
    get_shm_path(rack_name).touch()
    try:
        assert "0 bytes" in refusal(lambda: Segment.attach(rack_name))
    finally:
        unlink_segment(rack_name)


@as_root
def test_another_users_segment_is_refused(make_bus: MakeBus) -> None:
    segment = make_bus()

    def attach(why: str) -> bool:
        os.setuid(STRANGER)
        return why in refusal(lambda: Segment.attach(segment.rack))

    assert exit_status(fork(lambda: attach("belongs to another user"))) == 0
    # World-writable and another user's: its contents must not be trusted.
    get_shm_path(segment.rack).chmod(0o666)
    os.chown(get_shm_path(segment.rack), ANOTHER, ANOTHER)
    assert exit_status(fork(lambda: attach(f"owner {ANOTHER}"))) == 0


def test_a_processor_that_reorders_stores_is_refused_before_anything_is_made(
    rack_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "uname", lambda: SimpleNamespace(machine="aarch64"))
    before = descriptors()
    assert refusal(lambda: Segment.create(layout(rack_name, []), "")) == (
        f"rack '{rack_name}': the processor here is aarch64, and the backplane's memory order is"
        " proved for x86_64 alone"
    )
    assert descriptors() == before
    assert rack_name not in list_racks()


def test_a_lack_of_shared_memory_is_reported_at_creation(rack_name: str) -> None:
    too_large, before = layout(rack_name, [mailbox(depth=1 << 40)]), descriptors()
    for _ in range(2):
        message = refusal(lambda: Segment.create(too_large, ""))
        assert f"rack '{rack_name}'" in message
        assert "bytes of shared memory" in message
    assert descriptors() == before
    assert rack_name not in list_racks()


@pytest.mark.slow
def test_a_creator_killed_anywhere_leaves_a_whole_segment_or_none(rack_name: str) -> None:
    spec, rng = layout(rack_name, [mailbox(depth=4096)]), random.Random(1)
    created = complete = 0
    # On a busy machine it takes longer until one is complete.
    while created < 20 or not complete:
        creator = fork(lambda: Segment.create(spec, "x = 1"))
        created += 1
        time.sleep(rng.uniform(0.0, 0.0006 * created))
        kill(creator)
        if rack_name in list_racks():
            found = Segment.attach(rack_name)
            assert (found.layout, found.config, found.launcher_is_alive) == (spec, "x = 1", False)
            found.close()
            unlink_segment(rack_name)
            complete += 1


def test_a_launcher_counts_as_alive_until_it_releases_its_lock(make_bus: MakeBus) -> None:
    segment = make_bus()
    # Record locks of a process would be gone by now.
    Segment.attach(segment.rack).close()
    other = Segment.attach(segment.rack)
    assert (segment.launcher_is_alive, other.launcher_is_alive) == (True, True)
    assert not other.await_launcher(0.01)
    with in_thread(lambda: other.await_launcher(BOUND_S)):
        segment.release_launcher_lock()
    assert (segment.launcher_is_alive, other.launcher_is_alive) == (False, False)
    other.close()


def test_a_killed_launcher_is_dead_though_a_process_that_it_forked_lives_on(rack_name: str) -> None:
    reading, writing = os.pipe()

    def launch() -> None:
        segment = Segment.create(layout(rack_name), "")
        os.write(writing, b"%d\n" % fork(signal.pause))
        assert segment.launcher_is_alive
        signal.pause()

    with forked(launch) as launcher:
        orphan = int(os.read(reading, 20))
        found = Segment.attach(rack_name)
        assert found.launcher_is_alive
        os.kill(launcher, signal.SIGKILL)
        try:
            assert found.await_launcher(BOUND_S)
            assert runs(orphan)
            assert not found.launcher_is_alive
        finally:
            os.kill(orphan, signal.SIGKILL)
            unlink_segment(rack_name)
            found.close()


def test_a_launcher_of_another_pid_namespace_has_no_process_id_here(make_bus: MakeBus) -> None:
    segment = make_bus()
    assert segment.launcher_text == f"process {os.getpid()}"
    segment.words[Head.LAUNCHER_NAMESPACE] += 1
    assert (segment.launcher, segment.launcher_is_alive) == (0, True)


def test_a_segment_detects_that_its_name_leads_to_another(make_bus: MakeBus) -> None:
    first = make_bus()
    assert first.is_named
    unlink_segment(first.rack)
    assert not first.is_named
    second = make_bus()
    assert (first.is_named, second.is_named) == (False, True)
