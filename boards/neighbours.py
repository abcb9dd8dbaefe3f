"""Other racks that run on this machine: whose real-time boards hold which cores.

Two boards of real-time priority on one core starve each other, and each rack sees only its own lateness. Racks in
lockstep, and tasks of ordinary scheduling, hold nothing: they wait.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from rack.backplane.address_map import CLOCK
from rack.backplane.errors import SegmentError
from rack.backplane.segment import Segment, racks
from rack.backplane.words import Block, Run, System
from rack.boards.config.layout import obtained_core
from rack.boards.config.schema import RackConfig


@dataclass(frozen=True)
class Holder:
    """A rack that holds a core, and with which of its tasks."""

    rack: str
    launcher: int
    tasks: tuple[str, ...]

    def __str__(self) -> str:
        """Return it as words."""
        return f"rack '{self.rack}' (process {self.launcher}) runs {', '.join(self.tasks)} there at real-time priority"


def holders(own: str) -> dict[int, Holder]:
    """Return who holds which core, the rack called `own` left out."""
    found: dict[int, Holder] = {}
    for name in racks():
        if name == own:
            continue
        try:
            segment = Segment.attach(name)
        except SegmentError:
            continue
        if segment.launcher_is_alive and not segment.words[System.LOCKSTEP]:
            for core, tasks in _held(segment).items():
                found.setdefault(core, Holder(name, segment.launcher, tuple(tasks)))
        segment.close()
    return found


def _held(segment: Segment) -> dict[int, list[str]]:
    if segment.words[System.STATE] == Run.STOPPED:
        return {}
    held: dict[int, list[str]] = {}
    for task in segment.layout.tasks:
        if segment.block(task.name)[Block.PRIORITY]:
            held.setdefault(task.core, []).append(task.name)
    # Any program may have made the segment: its config is a stranger's.
    clock = tomllib.loads(segment.config).get("clock", {})
    # Where a board was refused its priority the clock was, too.
    if held and clock.get("priority"):
        held.setdefault(obtained_core(clock["core"]), []).append(CLOCK)
    return held


def placed(config: RackConfig, held: Mapping[int, Holder]) -> tuple[RackConfig, list[str]]:
    """Return the config with boards moved off held cores where it names none for them, and what was moved, as words."""
    free = [core for core in sorted(os.sched_getaffinity(0)) if core not in held]
    if not free or config.clock.mode == "lockstep":
        return config, []
    moved = {
        name: board
        for name, board in config.board.items()
        if board.priority and "core" not in board.model_fields_set and obtained_core(board.core) in held
    }
    boards = {name: board.model_copy(update={"core": free[0]}) for name, board in moved.items()}
    notes = [f"{name} on core {free[0]}: {held[obtained_core(board.core)]}" for name, board in moved.items()]
    return config.model_copy(update={"board": {**config.board, **boards}}), notes


def conflicts(config: RackConfig, held: Mapping[int, Holder]) -> list[str]:
    """Return a line for every core that another rack holds and real-time tasks of a config ask for."""
    wanted: dict[int, list[str]] = {}
    for task, core in _wanted(config):
        wanted.setdefault(obtained_core(core), []).append(task)
    both = sorted(wanted.keys() & held.keys()) if config.clock.mode == "realtime" else []
    return [f"core {core}, asked for by {', '.join(wanted[core])}: {held[core]}" for core in both]


def _wanted(config: RackConfig) -> Iterator[tuple[str, int]]:
    """Yield the tasks of real-time priority, each with its core."""
    if config.clock.priority:
        yield CLOCK, config.clock.core
    for name, board in config.board.items():
        if board.priority:
            yield name, board.core
        if board.planner_priority:
            yield f"{name}.planner", board.core if board.planner_core is None else board.planner_core
