"""From config to layout: writers, readers, delays and depths."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rack.backplane.layout import compute_depth
from rack.boards.config import list_replaced_cores, load, resolve, resolve_layout
from rack.boards.config import resolved as resolved
from rack.boards.config.layout import find_core
from rack.boards.config.rules import apply_rules


def test_mailboxes_have_the_readers_that_levels_name_and_the_delay_of_their_writers_slice(
    small: Path,
) -> None:
    layout = resolve_layout(load(small))
    assert {m.name: (m.writer, m.readers, m.every, m.delay) for m in layout.mailboxes} == {
        "upper.command": ("upper", ("lower", "lower.planner"), 8, 8),
        "upper.status": ("upper", (), 8, 8),
        "lower.status": ("lower", ("upper",), 1, 1),
        "lower.plan": ("lower.planner", ("lower",), 1, 4),
    }


def test_mailboxes_retain_two_seconds_and_at_least_their_readers_slice(small: Path) -> None:
    layout = resolve_layout(load(small, ["board.lower.within_cycles=9000"]))
    assert layout.find_mailbox("lower.status").depth == compute_depth(800, 1)
    assert layout.find_mailbox("upper.command").depth == compute_depth(9008, 8)


def test_missing_cores_are_replaced_and_reported(
    small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {2, 3})
    assert [find_core(core) for core in range(6)] == [2, 3, 2, 3, 2, 3]
    assert list_replaced_cores(
        load(small, ["board.upper.core=5", "clock.core=3", "board.lower.core=2"])
    ) == ["core 5 is not available (available: 2, 3): core 3 runs upper"]


def test_a_launch_resolves_and_checks_everything_once(
    small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checked = []
    monkeypatch.setattr(resolved, "apply_rules", lambda *of: checked.append(of) or apply_rules(*of))
    settings = [
        "fault=[{ kind = 'self-test', board = 'upper' }]",
        "board.lower.transfer.read_ms=0.5",
    ]
    found = resolve(load(small, settings))
    assert len(checked) == 1
    assert [(task.task, task.fails_self_test, task.guards_clock) for task in found.tasks] == [
        ("upper", True, False),
        ("lower", False, True),
        ("lower.planner", False, False),
    ]
    assert (len(found.faults), found.commands, found.ends_run) == (1, (), "upper.status")
    assert found.tasks[1].transfer.read_ns == 500_000
    assert [task.wake for task in found.layout.tasks] == ["timer"] * 3
    clock = found.build_clock_wiring(10.0)
    assert (clock.stop_tick, clock.linger, clock.silent, clock.history) == (4000, 200, 12_000, 400)


def test_a_board_may_override_the_racks_wake_and_a_planner_never_polls(small: Path) -> None:
    polling = ("wake=poll", "core=1", "coupling=loose", "planner_slot=9", "planner_core=0")
    settings = ["clock.wake=signal", *(f"board.lower.{setting}" for setting in polling)]
    wakes = {task.name: task.wake for task in resolve(load(small, settings)).layout.tasks}
    assert wakes == {"upper": "signal", "lower": "poll", "lower.planner": "timer"}


def test_a_queue_has_room_for_unread_messages_and_a_late_recorder() -> None:
    layout = resolve_layout(load("penn"))
    sizes = {box.name: (box.capacity, box.depth) for box in layout.mailboxes}
    # Of a host board: its capacity, what may be under way, and what a writer needs; a power of two.
    assert sizes["coordinator.requests"] == (32, 64)
    # Two seconds of four messages in each cycle of 20 ms, twice the capacity more.
    assert sizes["bridge.requests"] == (32, 512)
    # Two seconds of the reader's cycles.
    assert sizes["bridge.requests_taken"] == (0, 128)
    slow = resolve_layout(load("penn", ["protocol.depth={ 'bridge.requests' = 4 }"]))
    requests = slow.find_mailbox("bridge.requests")
    assert (requests.capacity, requests.depth) == (4, 256)
