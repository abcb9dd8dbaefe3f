"""Other racks on this machine, and the cores that their real-time boards occupy.

Two real-time boards on one core starve each other, and each rack sees only its own lateness. Racks
in lockstep and tasks with ordinary priority do not occupy a core, because they can wait.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rack.backplane.address_map import CLOCK
from rack.backplane.bounded_toml import load_toml
from rack.backplane.errors import SegmentError
from rack.backplane.process import SCHED_DEADLINE
from rack.backplane.segment import Segment, list_racks
from rack.backplane.words import Block, Run, System
from rack.boards.config.layout import find_core
from rack.boards.config.schema import RackConfig


@dataclass(frozen=True)
class Holder:
    """A rack that occupies a core.

    Attributes:
        rack: Name of the rack.
        process: Text that names its launcher or, for another user's rack, one of its boards.
        tasks: Its tasks on the core.
    """

    rack: str
    process: str
    tasks: tuple[str, ...]

    def __str__(self) -> str:
        """Return the holder as a clause for error texts."""
        return (
            f"rack '{self.rack}' ({self.process}) runs {', '.join(self.tasks)} on it at"
            " real-time priority"
        )


def find_holders(ignored: str) -> dict[int, Holder]:
    """Return a dictionary from each occupied core to the rack that occupies it.

    Args:
        ignored: Name of a rack that is left out.
    """
    occupied: dict[int, Holder] = {}
    for name in set(list_racks()) - {ignored}:
        try:
            segment = Segment.attach(name)
        except SegmentError:
            # The segment of another user or version cannot be read, but the processes can be found.
            occupied = {**_find_cores_of_processes(name), **occupied}
            continue
        if segment.launcher_is_alive and not segment.words[System.LOCKSTEP]:
            for core, tasks in _find_cores_of_rack(segment).items():
                occupied.setdefault(core, Holder(name, segment.launcher_text, tuple(tasks)))
        segment.close()
    return occupied


def _find_cores_of_processes(rack: str) -> dict[int, Holder]:
    """Find the cores of a rack by its real-time processes, which are named after the rack."""
    occupied: dict[int, Holder] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        pid = int(folder.name)
        # The process may have ended.
        with suppress(OSError):
            # The kernel truncates names to 15 characters: see `process.name_process`.
            name = (folder / "comm").read_text().strip()
            policy = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK
            if name.startswith(f"{rack}:"[:15]) and policy in (os.SCHED_FIFO, SCHED_DEADLINE):
                for core in os.sched_getaffinity(pid):
                    others = occupied[core].tasks if core in occupied else ()
                    occupied[core] = Holder(
                        rack, f"process {pid}", (*others, name.removeprefix(f"{rack}:"))
                    )
    return occupied


def _find_cores_of_rack(segment: Segment) -> dict[int, list[str]]:
    """Return a dictionary from core to the real-time tasks of a running rack on that core."""
    occupied: defaultdict[int, list[str]] = defaultdict(list)
    if segment.words[System.STATE] == Run.STOPPED:
        return occupied
    for task in segment.layout.tasks:
        if segment.get_block(task.name)[Block.PRIORITY]:
            occupied[task.core].append(task.name)
    # The config is not validated: another version of this program may have created the segment.
    clock = load_toml(segment.config).get("clock", {})
    # If the boards have their priorities, the clock has its priority too.
    if occupied and clock.get("priority"):
        occupied[find_core(clock["core"])].append(CLOCK)
    return occupied


def move_boards(config: RackConfig, held: Mapping[int, Holder]) -> tuple[RackConfig, list[str]]:
    """Move boards from occupied cores to a free core, unless the config specifies their core.

    Args:
        config: The config.
        held: Dictionary from each occupied core to the rack that occupies it.

    Returns:
        The changed config and a line for each moved board.
    """
    free = [core for core in sorted(os.sched_getaffinity(0)) if core not in held]
    if not free or config.is_lockstep:
        return config, []
    moved = {
        name: board
        for name, board in config.board.items()
        if board.priority and "core" not in board.model_fields_set and find_core(board.core) in held
    }
    boards = {name: board.model_copy(update={"core": free[0]}) for name, board in moved.items()}
    notes = [
        f"{name} on core {free[0]}: {held[find_core(board.core)]}" for name, board in moved.items()
    ]
    return config.model_copy(update={"board": {**config.board, **boards}}), notes


def find_conflicts(config: RackConfig, held: Mapping[int, Holder]) -> list[str]:
    """Return a line for each core that real-time tasks of this config share with another rack."""
    if config.is_lockstep:
        return []
    requested: defaultdict[int, list[str]] = defaultdict(list)
    if config.clock.priority:
        requested[find_core(config.clock.core)].append(CLOCK)
    for task in (*config.list_tasks(), *config.list_standbys()):
        if task.priority:
            requested[find_core(task.core)].append(task.name)
    return [
        f"core {core}, requested by {', '.join(requested[core])}: {held[core]}"
        for core in sorted(requested.keys() & held.keys())
    ]
