"""The list of a rack's state is whole: what is new in the segment, or changes outside of objects,
is in a checkpoint, or stands here with the reason why not."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterable, Iterator
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from rack.backplane.address_map import (
    ALARM_SIZE,
    BLOCK_SIZE,
    CLOCK,
    MAILBOX_HEAD_SIZE,
    OPERATOR_ENTRIES,
    TRACE_RECORD_SIZE,
    mailbox_size,
    operator_entry_size,
    trace_size,
)
from rack.backplane.segment import Segment, unlink
from rack.backplane.words import Block, Box, System
from rack.boards import OneProcess
from rack.boards.checkpoint.memory import OF_LAUNCH, OF_PROCESS, OF_WRITER, TRACES, regions
from rack.boards.checkpoint.parts import FLOORS
from rack.boards.config import load, resolve

SYSTEM = """TICK CLOCK_SKIPPED FOLLOWER_TICK FAULTS DEMAND INJECTED LOSSES SYSRESET ACFAIL
EMERGENCY_STOP REQUESTED COMMANDED PEER_STOP SKIPPED_FROM
FOLLOWER_DRAINED"""
BLOCK = """RELEASED DEADLINE DONE CYCLES MISSED SKIPPED READS READ_BYTES WRITES WRITE_BYTES CORRUPT
BUS_ERRORS TRACE_HEAD LEVEL_STATE PLANS LOST LEVEL_SINCE AWAITS INTERRUPTS INTERRUPTS_LOST
INTERRUPTS_WAITING CLOCK_SKIPPED WAITS_UNTIL TRACE_FIRST FIRST FAILED"""
BOX = "HEAD EPOCH REFUSED SENT TAKEN VOID KEPT POSITION FIRST"
"""Words that a checkpoint holds; those of a launch, of a process and of a writer it does not."""
OUTSIDE = {"SYSFAIL"}
"""The self-tests of the boards that continue."""


@pytest.mark.parametrize(
    ("words", "kept", "not_kept"),
    [(System, SYSTEM, OF_LAUNCH), (Block, BLOCK, OF_PROCESS), (Box, BOX, OF_WRITER)],
)
def test_each_word_is_kept_or_of_one_launch(
    words: Any, kept: str, not_kept: tuple[int, ...]
) -> None:
    names = {place: name for name, place in vars(words).items() if name.isupper()}
    lost = {names[place] for place in not_kept}
    assert {*kept.split(), *lost} == set(names.values()) - OUTSIDE
    assert not set(kept.split()) & lost


@pytest.fixture
def segment(rack_name: str) -> Iterator[Segment]:
    """The segment of a rack with queues and a host's mailboxes, all of whose rings are full."""
    config = load("rccl", [f"name={rack_name}"])
    found = Segment.create(resolve(config).layout, config.text())
    for box in found.layout.mailboxes:
        found.box(box.name)[Box.HEAD] = 10 * box.depth + 3
    for task in found.layout.processes:
        # Nobody has read anything yet.
        found.block(task.name)[Block.RELEASED] = -(1 << 20)
        found.block(task.name)[Block.TRACE_HEAD] = 10 * task.depth + 3
    try:
        yield found
    finally:
        unlink(rack_name)
        found.close()


def test_each_area_of_the_segment_is_kept_but_the_head_and_old_traces(segment: Segment) -> None:
    layout, places = segment.layout, segment.map
    assert set(vars(places)) == {
        *("faults", "operator", "alarms", "blocks", "traces", "mailboxes"),
        *("windows", "size"),
    }
    kept = np.zeros(places.size, bool)
    for address, size in regions(segment, 0):
        assert not kept[address : address + size].any()
        kept[address : address + size] = True
    assert kept[8 * System.STATE : 8 * System.SYSFAIL].all()
    assert not kept[: 8 * System.STATE].any()
    entries = OPERATOR_ENTRIES * operator_entry_size(layout)
    assert kept[places.faults : places.operator + entries].all()
    for owner in (CLOCK, *(task.name for task in layout.processes)):
        assert kept[places.alarms[owner] : places.alarms[owner] + ALARM_SIZE].all()
    for task in layout.processes:
        assert kept[places.blocks[task.name] : places.blocks[task.name] + BLOCK_SIZE].all()
    for box in layout.mailboxes:
        begin = places.mailboxes[box.name]
        # What nobody reads is only continued.
        size = mailbox_size(box) if box.readers else MAILBOX_HEAD_SIZE
        assert kept[begin : begin + size].all(), box.name
    for task in layout.processes:
        begin = places.traces[task.name]
        assert kept[begin : begin + trace_size(task)].sum() == TRACES * TRACE_RECORD_SIZE


def variables(modules: Iterable[tuple[str, ModuleType]]) -> dict[str, object]:
    """Return the variables of modules and of their classes, by their places: containers by their
    contents, all else by what they are."""
    found = {}
    for name, module in modules:
        owners: dict[str, Any] = {name: module}
        for value in vars(module).values():
            if isinstance(value, type) and value.__module__ == name:
                owners[f"{name}.{value.__qualname__}"] = value
        for place, owner in owners.items():
            for key, value in [*vars(owner).items()]:
                if not key.startswith("__") and not isinstance(value, ModuleType):
                    found[f"{place}.{key}"] = _contents(value)
    return found


def _contents(value: object) -> object:
    match value:
        case dict() | list() | set() | deque() | bytearray():
            return repr(value)
        case np.ndarray():
            return value.tobytes()
    return id(value)


@pytest.mark.slow
def test_no_variable_of_a_module_or_class_changes_while_a_rack_runs() -> None:
    with OneProcess.from_file("nasrem") as rack:
        rack.run(0.3)
        modules = [(name, sys.modules[name]) for name in sys.modules if name.startswith(FLOORS)]
        before = variables(modules)
        rack.run(2.0)
        after = variables(modules)
    assert len(before) > 1000
    changed = {name for name in before | after if before.get(name) != after.get(name)}
    assert changed == set()
