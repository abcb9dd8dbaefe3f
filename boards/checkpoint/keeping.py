"""Taking checkpoints: the clock asks every task for its state between two ticks, when all have
finished, and puts one file together.

The tasks save theirs at the same time, each on its core; a thread of the clock compresses and
writes, while the rack goes on. A checkpoint that falls into the outage of a board is taken once
the board is back: a process that is not there has no state.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Thread

from rack.backplane.address_map import CLOCK
from rack.backplane.clock.lockstep import LockstepDriver
from rack.backplane.json_text import encode_json
from rack.backplane.mailbox.mailbox import Writer
from rack.backplane.process import set_priority
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, System
from rack.boards.checkpoint.format import (
    ATTRIBUTES,
    Checkpoint,
    PartState,
    layout_hash,
    read,
)
from rack.boards.checkpoint.kinds import Keeper
from rack.boards.checkpoint.memory import copy, regions
from rack.boards.checkpoint.parts import Parts
from rack.boards.checkpoint.shown import Attributes
from rack.boards.errors import UNKEPT, CheckpointError
from rack.boards.run.task import Task
from rack.boards.wiring import Keeping

STATE = ".state"
"""Suffix of the file that a task leaves for the clock."""
SHAPE = 16
"""Bytes of a shape in front of the state that a task leaves for the clock."""
REFUSED = -1
"""Value of `Block.SAVE` of a task whose state cannot be kept."""


def keep_task(segment: Segment, task: Task, keeping: Keeping) -> None:
    """Have a task that has just been built save its state when the clock wants it; in a run that
    continues another, let it go on from the state there.

    A task that cannot says so, and the run goes on without checkpoints.
    """
    keeper = task.next_cycle.save = TaskKeeper(task, keeping)
    try:
        keeper.parts = Parts(task, task.spec.name)
    except CheckpointError as error:
        if keeping.origin is not None:
            raise
        print(f"{UNKEPT}{error}", file=sys.stderr, flush=True)
        task.block[Block.SAVE] = REFUSED
    else:
        _go_on(segment, keeper.parts, task.spec.name, keeping)


def keep_clock(segment: Segment, driver: LockstepDriver, keeping: Keeping) -> Callable[[], None]:
    """Have the clock take checkpoints; in a run that continues another, let it go on. Return what
    waits for the last one."""
    keeper = driver.keep = ClockKeeper(segment, driver, keeping)
    keeper.parts = Parts(driver, CLOCK)
    _go_on(segment, keeper.parts, CLOCK, keeping)
    return keeper.finish


def _go_on(segment: Segment, parts: Parts, name: str, keeping: Keeping) -> None:
    """Continue from the state of that name in a checkpoint, when the rack is launched; a process
    that is restarted later begins anew."""
    if keeping.origin is None or segment.words[System.STATE] != Run.STARTING:
        return
    found = read(keeping.origin).parts[name]
    if found.shape != parts.shape:
        why = "its class, or what it is made of, has changed shape since"
        raise CheckpointError(f"'{name}' cannot continue from {keeping.origin}: {why}")
    parts.load(found.changed, keeping.packages)
    for writer in parts.of_type(Writer):
        writer.sign()


class TaskKeeper(Keeper):
    """Saves the state of one task, between two of its cycles, for the clock to collect."""

    def __init__(self, task: Task, keeping: Keeping) -> None:
        self.parts: Parts | None = None
        self._block = task.block
        self._notify_clock = task.stopwatch.notify_clock
        self._path = keeping.folder / f"{task.spec.name}{STATE}"
        # A task has its level under the name of its role.
        self._level = getattr(task, task.spec.role) if keeping.shows else None

    def __call__(self) -> None:
        """Save it."""
        result = REFUSED
        try:
            if self.parts is not None:
                self._save(self.parts)
                result = 0
        except (CheckpointError, OSError) as error:
            print(f"no checkpoint: {error}", file=sys.stderr, flush=True)
        self._block[Block.SAVE] = result
        self._notify_clock()

    def _save(self, parts: Parts) -> None:
        if self._level is not None:
            attributes = encode_json(Attributes(parts).of(self._level))
            self._path.with_suffix(ATTRIBUTES).write_text(attributes)
        self._path.write_bytes(bytes.fromhex(parts.shape) + parts.save())


class ClockKeeper(Keeper):
    """Takes the checkpoints of a run."""

    def __init__(self, segment: Segment, driver: LockstepDriver, keeping: Keeping) -> None:
        self.parts: Parts
        self._segment = segment
        self._driver = driver
        self._folder = keeping.folder
        self._every = keeping.every
        self._at = keeping.at
        self._layout = layout_hash(segment.layout)
        self._due: int | None = None
        self._writing: Thread | None = None

    def __call__(self, tick: int) -> int:
        """Take a checkpoint before `tick`, if one is due and every process is there; return the
        next tick before which one is."""
        if self._due is None:
            self._due = _next(tick, self._every) if self._at is None else self._at
            if any(task.block[Block.SAVE] == REFUSED for task in self._driver.tasks):
                self._due = sys.maxsize
        if tick < self._due:
            return self._due
        if any(task.is_lost or task.is_stopped for task in self._driver.tasks):
            return tick + 1
        self._due = _next(tick, self._every)
        self._driver.settle()
        if all(task.is_settled() for task in self._driver.tasks):
            self._take(tick)
        return self._due

    def _take(self, tick: int) -> None:
        driver = self._driver
        try:
            # Here, since a short run has none.
            self._folder.mkdir(exist_ok=True)
        except OSError as error:
            print(f"no checkpoint: {error}", file=sys.stderr, flush=True)
            return
        for task in driver.tasks:
            task.block[Block.SAVE] = tick + 1
            task.wake()
        for task in driver.tasks:
            driver.await_state(task, partial(_has_saved, task.block))
        has_all = not any(task.block[Block.SAVE] for task in driver.tasks)
        for task in driver.tasks:
            task.block[Block.SAVE] = 0
        if not has_all:
            return
        places = regions(self._segment, tick)
        try:
            parts = {CLOCK: PartState(self.parts.shape, self.parts.save())}
            for task in driver.tasks:
                path = self._folder / f"{task.spec.name}{STATE}"
                state = path.read_bytes()
                parts[task.spec.name] = PartState(state[:SHAPE].hex(), state[SHAPE:])
                path.unlink()
        except (CheckpointError, OSError) as error:
            print(f"no checkpoint: {error}", file=sys.stderr, flush=True)
            return
        found = Checkpoint(tick, self._layout, places, copy(self._segment, places), parts)
        self.finish()
        self._writing = Thread(target=_write, args=(found, self._folder))
        self._writing.start()
        if tick == self._at:
            # Whoever asked for it waits for it.
            self.finish()

    def finish(self) -> None:
        """Wait until the last checkpoint is written."""
        if self._writing is not None:
            self._writing.join()


def _write(found: Checkpoint, folder: Path) -> None:
    """Write a checkpoint, in a thread that takes no core from a board."""
    set_priority(0)
    os.sched_setaffinity(0, os.sched_getaffinity(os.getppid()))
    try:
        found.write(folder)
    except OSError as error:
        print(f"no checkpoint: {error}", file=sys.stderr, flush=True)


def _next(tick: int, every: int) -> int:
    """Return the first multiple of `every` after `tick`."""
    return tick - tick % every + every if every else sys.maxsize


def _has_saved(block: memoryview) -> bool:
    return block[Block.SAVE] <= 0
