"""Other racks on this machine, and the cores occupied by their real-time boards.

Two real-time boards on one core starve each other, and each rack sees only its own lateness. Racks
in lockstep and tasks at ordinary priority occupy no core: they can wait.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rack.backplane.address_map import CLOCK
from rack.backplane.bounded_toml import load_toml
from rack.backplane.errors import SegmentError
from rack.backplane.process import SCHED_DEADLINE
from rack.backplane.segment import Segment, racks
from rack.backplane.words import Block, Run, System
from rack.boards.config.layout import obtained_core
from rack.boards.config.schema import RackConfig


@dataclass(frozen=True)
class Holder:
    """A rack that occupies a core, and its tasks there. Of another user's rack, `process` is one of
    the boards, otherwise the launcher.
    """

    rack: str
    process: str
    tasks: tuple[str, ...]

    def __str__(self) -> str:
        """Return the holder as text."""
        return (
            f"rack '{self.rack}' ({self.process}) runs {', '.join(self.tasks)} on it at"
            " real-time priority"
        )


def holders(own: str) -> dict[int, Holder]:
    """Return the holder of each core, ignoring the rack `own`."""
    found: dict[int, Holder] = {}
    for name in racks():
        if name == own:
            continue
        try:
            segment = Segment.attach(name)
        except SegmentError:
            # Another user's, or of another version: its processes still show what it occupies.
            found = {**_seen(name), **found}
            continue
        if segment.launcher_is_alive and not segment.words[System.LOCKSTEP]:
            for core, tasks in _held(segment).items():
                found.setdefault(core, Holder(name, segment.launcher_text, tuple(tasks)))
        segment.close()
    return found


def _seen(rack: str) -> dict[int, Holder]:
    held: dict[int, Holder] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        pid = int(folder.name)
        with suppress(OSError):  # it has ended meanwhile
            # The kernel keeps 15 characters: see `process.name_process`.
            name = (folder / "comm").read_text().strip()
            policy = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK
            if name.startswith(f"{rack}:"[:15]) and policy in (os.SCHED_FIFO, SCHED_DEADLINE):
                for core in os.sched_getaffinity(pid):
                    others = held[core].tasks if core in held else ()
                    held[core] = Holder(
                        rack, f"process {pid}", (*others, name.removeprefix(f"{rack}:"))
                    )
    return held


def _held(segment: Segment) -> dict[int, list[str]]:
    if segment.words[System.STATE] == Run.STOPPED:
        return {}
    held: dict[int, list[str]] = {}
    for task in segment.layout.tasks:
        if segment.block(task.name)[Block.PRIORITY]:
            held.setdefault(task.core, []).append(task.name)
    # Another version of this program may have created the segment, so its config is not validated
    # here.
    clock = load_toml(segment.config).get("clock", {})
    # If the boards were refused their priority, so was the clock.
    if held and clock.get("priority"):
        held.setdefault(obtained_core(clock["core"]), []).append(CLOCK)
    return held


def placed(config: RackConfig, held: Mapping[int, Holder]) -> tuple[RackConfig, list[str]]:
    """Return the config with boards moved off occupied cores, unless it names their core, and a
    note on each move.
    """
    free = [core for core in sorted(os.sched_getaffinity(0)) if core not in held]
    if not free or config.clock.mode == "lockstep":
        return config, []
    moved = {
        name: board
        for name, board in config.board.items()
        if board.priority
        and "core" not in board.model_fields_set
        and obtained_core(board.core) in held
    }
    boards = {name: board.model_copy(update={"core": free[0]}) for name, board in moved.items()}
    notes = [
        f"{name} on core {free[0]}: {held[obtained_core(board.core)]}"
        for name, board in moved.items()
    ]
    return config.model_copy(update={"board": {**config.board, **boards}}), notes


def conflicts(config: RackConfig, held: Mapping[int, Holder]) -> list[str]:
    """Return a line for every core that another rack occupies and a real-time task of this config
    requests.
    """
    tasks = [
        (CLOCK, config.clock.core, config.clock.priority),
        *((t.name, t.core, t.priority) for t in config.tasks()),
    ]
    wanted: dict[int, list[str]] = {}
    for task, core, priority in tasks:
        if priority:
            wanted.setdefault(obtained_core(core), []).append(task)
    both = sorted(wanted.keys() & held.keys()) if config.clock.mode == "realtime" else []
    return [f"core {core}, requested by {', '.join(wanted[core])}: {held[core]}" for core in both]
