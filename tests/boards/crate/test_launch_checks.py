"""Launch checks: refused priorities, memory that is not locked, and idle cores."""

from __future__ import annotations

import os
from resource import RLIMIT_MEMLOCK, getrlimit

import pytest

from rack.backplane.segment import Segment
from rack.backplane.words import Block
from rack.boards.config.resolved import Resolved, resolve
from rack.boards.crate.launch_checks import check_realtime, list_launch_notes
from rack.boards.errors import LaunchError
from tests.boards.conftest import MakeConfig, MakeSegment

REFUSED = "SCHED_FIFO refused, ordinary scheduling for wave"


@pytest.fixture
def memory(config: MakeConfig, make_segment: MakeSegment) -> tuple[Resolved, Segment]:
    """A rack of which one board wants a real-time priority, and its memory."""
    plan = resolve(
        config("clock.mode=realtime", "clock.on_no_realtime=refuse", "board.wave.priority=50")
    )
    return plan, make_segment(plan.layout, "")


def test_a_refused_priority_is_noted_and_ends_the_launch_if_configured(
    memory: tuple[Resolved, Segment], config: MakeConfig
) -> None:
    plan, segment = memory
    for task in plan.layout.tasks:
        segment.get_block(task.name)[Block.PRIORITY] = task.priority
    check_realtime(plan, segment)
    assert not [note for note in list_launch_notes(plan, segment) if "SCHED_FIFO" in note]
    segment.get_block("wave")[Block.PRIORITY] = 0
    (note,) = [note for note in list_launch_notes(plan, segment) if "SCHED_FIFO" in note]
    assert note.startswith(f"{REFUSED}; missed deadlines are likely")
    with pytest.raises(LaunchError, match=REFUSED):
        check_realtime(plan, segment)
    # In lockstep there are no deadlines to miss.
    stepped = resolve(config("clock.on_no_realtime=refuse", "board.wave.priority=50"))
    check_realtime(stepped, segment)
    assert not [note for note in list_launch_notes(stepped, segment) if "SCHED_FIFO" in note]


def test_memory_that_is_not_locked_is_noted_with_its_limit(
    memory: tuple[Resolved, Segment], config: MakeConfig
) -> None:
    plan, segment = memory
    for task in plan.layout.tasks:
        # The test's own process, which locks none.
        segment.get_block(task.name)[Block.PID] = os.getpid()
    limit = getrlimit(RLIMIT_MEMLOCK)[0]
    said = f"memory not locked for wave, wave.planner, watch: the limit is {limit} bytes, a board "
    (note,) = [note for note in list_launch_notes(plan, segment) if "not locked" in note]
    assert note.startswith(said)
    in_lockstep = list_launch_notes(resolve(config()), segment)
    assert not [note for note in in_lockstep if "not locked" in note]


def test_a_launch_notes_whether_idle_cores_are_kept_awake(
    memory: tuple[Resolved, Segment], config: MakeConfig
) -> None:
    plan, segment = memory
    assert not [note for note in list_launch_notes(plan, segment) if "idle_cores" in note]
    awake = resolve(config("clock.mode=realtime", "clock.idle_cores=awake"))
    (note,) = [note for note in list_launch_notes(awake, segment) if "idle_cores" in note]
    assert note.startswith('clock.idle_cores = "awake": ')
