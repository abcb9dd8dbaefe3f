"""A board: one process on one core, from its power-on to the end of the run."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from importlib import import_module
from socket import socket

from rack.backplane.address_map import CLOCK
from rack.backplane.errors import BackplaneError
from rack.backplane.lines import UtilityLines
from rack.backplane.memory import hold_memory, touch_memory
from rack.backplane.process import (
    die_with_parent,
    disable_timer_slack,
    keep_cores_awake,
    name_process,
    set_priority,
    take_core,
    write_line,
)
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, Scheduler, System, TaskState
from rack.boards.errors import UNRECOVERABLE_STATUS
from rack.boards.host.adapter import Adapter
from rack.boards.run.control_loop import PlannerLoop, VirtualControlLoop
from rack.boards.run.copying import Copier
from rack.boards.run.snapshots import copy_task, has_snapshots_enabled
from rack.boards.run.system_controller import run_clock
from rack.boards.run.task import Task
from rack.boards.wiring import ClockWiring, TaskWiring
from rack.levels.errors import CannotGoOn, LevelError
from rack.levels.level import Executor, Planner
from rack.levels.references import find_class

SELF_TEST_FAILED = 3
"""Exit status of a board that failed its self-test or could not set up its level."""
MAX_TOUCHED_CYCLE_NS = 10_000_000
"""Longest period of a task for which memory is touched in advance, in ns.

Touching takes a tenth of a second, and a task with a longer period has time for page faults.
"""


def run_board(crate: int, name: str, segment: Segment, board: Callable[[Segment], int]) -> int:
    """Run a board, as the main function of a process that the crate has forked.

    Args:
        crate: Process id of the crate.
        name: Name of the board.
        segment: Memory of the rack.
        board: Function that runs the board and returns its exit status.

    Returns:
        The exit status of the process, which is returned by the board or represents its error.
    """
    die_with_parent(crate)
    # Drop the crate's priority. The board takes another priority when it is ready.
    set_priority(0)
    name_process(f"{segment.rack}:{name}")
    try:
        return board(segment)
    except (BackplaneError, LevelError) as error:
        write_line(sys.stderr, f"board '{name}': {error}")
        return UNRECOVERABLE_STATUS if isinstance(error, CannotGoOn) else SELF_TEST_FAILED
    except Exception:
        write_line(sys.stderr, f"board '{name}' failed:\n{traceback.format_exc().rstrip()}")
        return 1


def run_task_board(segment: Segment, wiring: TaskWiring, attention: int, copies: socket) -> int:
    """Build a task's level, test it, pin the process to its core, and cycle until the run is over.

    Args:
        segment: Memory of the rack.
        wiring: Wiring of the task.
        attention: eventfd that wakes the Rack when the board is ready or raises an alarm.
        copies: Socket to the crate, on which copies of this process are reported.

    Returns:
        The exit status of the board.
    """
    block = segment.get_block(wiring.task)
    block[Block.PID] = os.getpid()
    block[Block.STATE] = TaskState.STARTING
    try:
        _run_level(segment, wiring, attention, copies)
    except BaseException:
        block[Block.STATE] = TaskState.FAILED
        UtilityLines(segment).assert_sysfail(segment.layout.find_task(wiring.task).slot)
        raise
    block[Block.STATE] = TaskState.ENDED
    return 0


def _run_level(segment: Segment, wiring: TaskWiring, attention: int, copies: socket) -> None:
    """Build and test the level of a task, then run its cycles. See `run_task_board`."""
    spec = segment.layout.find_task(wiring.task)
    copier = Copier(segment, wiring.task, copies) if has_snapshots_enabled(segment) else None
    kind: type[Executor] | type[Planner] = find_class(
        wiring.target, Planner if spec.role == "planner" else Executor
    )
    level = kind(wiring.context)
    if isinstance(level, Adapter):
        level.attach_segment(segment, wiring.entries)
    try:
        level.self_test()
        if wiring.fails_self_test:
            raise LevelError("self-test failed: injected by a fault in the config")
        UtilityLines(segment).release_sysfail(spec.slot)
        is_fast = spec.every * segment.layout.clock_ns <= MAX_TOUCHED_CYCLE_NS
        lockstep = bool(segment.words[System.LOCKSTEP])
        if is_fast and spec.priority and not lockstep:
            # Touch memory while the process still has ordinary priority, because a restarted board
            # must not delay another board's cycle.
            touch_memory()
        _take_scheduled_core(segment, wiring)
        disable_timer_slack()
        hold_memory(lockstep)
        if isinstance(level, Adapter):
            level.open_connections()
        task: Task
        if isinstance(level, Planner):
            task = PlannerLoop(segment, wiring, level, attention)
        elif len(segment.layout.list_copies(spec.board)) > 1:
            # Import it only in racks that have standbys.
            replica = import_module("rack.boards.run.replica")
            task = replica.ReplicatedLoop(segment, wiring, level, attention)
        else:
            task = VirtualControlLoop(segment, wiring, level, attention)
        if copier is not None:
            task.next_cycle.copy = partial(copy_task, task, copier, attention)
        segment.get_block(wiring.task)[Block.STATE] = TaskState.READY
        os.eventfd_write(attention, 1)
        task.stopwatch.notify_clock()
        task.run()
    finally:
        # Return to ordinary priority, because closing files must not delay another board's cycle.
        set_priority(0)
        level.close()


def _take_scheduled_core(segment: Segment, wiring: TaskWiring) -> None:
    """Pin the calling process to the core of its task, and give it the task's scheduler.

    After a restart this is the scheduler that the previous process had.
    """
    spec = segment.layout.find_task(wiring.task)
    block = segment.get_block(wiring.task)
    reservation = None
    if wiring.scheduling is not None:
        block[Block.SCHEDULER] = block[Block.SCHEDULER] or wiring.scheduling.scheduler
        if block[Block.SCHEDULER] == Scheduler.EARLIEST_DEADLINE_FIRST:
            reservation = wiring.scheduling.reservation
    _enter_exclusive_core(segment, spec.core)
    block[Block.PRIORITY] = take_core(spec.core, spec.priority, reservation)
    block[Block.CORE] = spec.core


def _enter_exclusive_core(segment: Segment, core: int) -> None:
    """Enter the group of a core that the rack has to itself."""
    if segment.words[System.EXCLUSIVE_CORES]:
        # Import it only in racks that need it.
        import_module("rack.backplane.exclusive_cores").enter_core(segment.rack, core)


def run_clock_board(segment: Segment, wiring: ClockWiring, attention: int, copies: socket) -> int:
    """Pin the process to its core and run the system clock until the run is over.

    Args:
        segment: Memory of the rack.
        wiring: Wiring of the clock.
        attention: eventfd that wakes the Rack when the clock raises an alarm.
        copies: Socket to the crate, on which copies of this process are reported.

    Returns:
        The exit status of the board.
    """
    copier = Copier(segment, CLOCK, copies) if has_snapshots_enabled(segment) else None
    _enter_exclusive_core(segment, wiring.core)
    take_core(wiring.core, wiring.priority, wiring.reservation)
    # Memory is not touched in advance, because every board waits for the start of the clock. The
    # clock's lead over its grid points leaves enough time for a page fault.
    hold_memory(wiring.lockstep)
    if wiring.copy is not None:
        # Import it only in racks whose clock has a standby. The lock ends with this process.
        clock_standby = import_module("rack.boards.run.clock_standby")
        clock_standby.await_clock_lock(segment, is_standby=wiring.copy > 0)
        if segment.words[System.STATE] == Run.STOPPED:
            return 0
    with keep_cores_awake() if wiring.keeps_awake else nullcontext():
        run_clock(segment, wiring, attention, copier)
    return 0
