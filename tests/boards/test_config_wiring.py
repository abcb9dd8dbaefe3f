"""From config to layout: who writes, who reads, how long it takes, how much is kept."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rack.backplane.layout import depth_for
from rack.backplane.mailbox.slots import message_dtype
from rack.boards.config import context, load, shared_out, task_ports, wire
from rack.boards.config.cores import obtained_core
from rack.boards.config.fields import field_specs
from rack.levels.messages import TASK_COMMAND, TASK_PLAN

SIZES = {"joints": 6, "bodies": 3, "state": 120}


def test_mailboxes_have_one_writer_and_the_readers_that_the_levels_name(small: Path) -> None:
    layout = wire(load(small))
    assert {m.name: (m.writer, m.readers) for m in layout.mailboxes} == {
        "upper.command": ("upper", ("lower", "lower.planner")),
        "upper.status": ("upper", ()),
        "lower.status": ("lower", ("upper",)),
        "lower.plan": ("lower.planner", ("lower",)),
    }


def test_a_message_is_delayed_by_its_writers_slice(small: Path) -> None:
    layout = wire(load(small))
    assert {m.name: (m.every, m.delay) for m in layout.mailboxes} == {
        "upper.command": (8, 8),
        "upper.status": (8, 8),
        "lower.status": (1, 1),
        "lower.plan": (1, 4),
    }


def test_mailboxes_keep_two_seconds_and_never_less_than_their_readers_slice(small: Path) -> None:
    layout = wire(load(small, ["board.lower.within_cycles=9000"]))
    assert layout.mailbox("lower.status").depth == depth_for(800, 1)
    assert layout.mailbox("upper.command").depth == depth_for(9008, 8)


def test_protocols_are_set_for_the_rack_and_for_one_mailbox(small: Path) -> None:
    settings = ["protocol.default=double-buffer", "protocol.mailbox={ 'lower.plan' = 'lock' }"]
    layout = wire(load(small, settings))
    assert layout.mailbox("lower.plan").protocol == "lock"
    assert layout.mailbox("upper.command").protocol == "double-buffer"


def test_a_tight_planner_shares_its_executors_board(small: Path) -> None:
    layout = wire(load(small, ["board.lower.priority=50"]))
    executor, planner = layout.task("lower"), layout.task("lower.planner")
    assert (planner.slot, planner.core) == (executor.slot, executor.core)
    assert (executor.priority, planner.priority) == (50, 0)
    assert (executor.within_cycles, planner.within_cycles) == (1, 4)


def test_a_loose_planner_has_a_board_of_its_own(small: Path) -> None:
    settings = ["board.lower.coupling=loose", "board.lower.planner_slot=9", "board.lower.planner_priority=20"]
    planner = wire(load(small, settings)).task("lower.planner")
    assert (planner.slot, planner.priority) == (9, 20)


def test_a_port_can_be_wired_to_another_mailbox(small: Path) -> None:
    config = load(small, ["board.lower.reads={ command = 'upper.command' }", "board.lower.above=upper"])
    assert task_ports(config, "lower", "executor").reads == {"command": "upper.command", "plan": "lower.plan"}


@pytest.mark.parametrize("kind", [TASK_COMMAND, TASK_PLAN], ids=lambda kind: kind.name)
def test_field_specs_describe_the_very_bytes_of_a_message(kind) -> None:
    dtype = kind.dtype(SIZES)
    described = message_dtype(field_specs(kind, SIZES), dtype.itemsize)
    assert described.itemsize == dtype.itemsize
    for name in dtype.names:
        assert described.fields[name][1] == dtype.fields[name][1]
        assert described[name].shape == dtype[name].shape
    assert described["moves"].base.fields["position"][1] == dtype["moves"].base.fields["position"][1]


def test_cores_that_the_machine_lacks_are_shared_out_and_told(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {2, 3})
    assert [obtained_core(core) for core in range(6)] == [2, 3, 2, 3, 2, 3]
    assert shared_out(load(small, ["board.upper.core=5", "clock.core=3", "board.lower.core=2"])) == [
        "core 5 is not available (available: 2, 3): upper on core 3"
    ]


def test_context_tells_a_level_its_rack_in_ticks(small: Path) -> None:
    told = context(load(small, ["board.lower.params.gain=2", "seed=5"]), "lower")
    assert (told.board, told.every, told.within_cycles, told.clock_ns, told.seed) == ("lower", 1, 4, 2_500_000, 5)
    assert told.below is None
    assert context(load(small), "upper").below == (1, 4)
    assert told.params == {"gain": 2}
