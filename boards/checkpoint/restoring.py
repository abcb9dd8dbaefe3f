"""Launching a rack that takes checkpoints, or continues from one; and who has none."""

from __future__ import annotations

from contextlib import suppress

from rack.backplane.segment import Segment
from rack.boards.checkpoint.format import Checkpoint, layout_hash, read
from rack.boards.checkpoint.memory import fill
from rack.boards.checkpoint.parts import FLOORS, Parts
from rack.boards.checkpoint.taking import outside
from rack.boards.classes import find_class
from rack.boards.config.resolved import Resolved
from rack.boards.errors import CheckpointError
from rack.boards.wiring import Keeping
from rack.levels.errors import LevelError
from rack.levels.level import LevelSection


def origin(plan: Resolved, keeping: Keeping) -> Checkpoint | None:
    """Return the checkpoint from which a rack continues, if it is to.

    Raises `CheckpointError` for a rack that has none, and for a checkpoint of another rack.
    """
    rack = plan.config.name
    if plan.config.clock.mode != "lockstep":
        raise CheckpointError(f"rack '{rack}': checkpoints are taken in lockstep; add --lockstep")
    # In a replay what came from outside is in the wiring.
    if not plan.is_replay and (why := outside(plan.config)):
        raise CheckpointError(f"rack '{rack}' has no checkpoints: {why}")
    if keeping.origin is None:
        return None
    found = read(keeping.origin)
    if found.layout != layout_hash(plan.layout):
        why = "of a rack with other tasks, mailboxes or messages"
        raise CheckpointError(f"{keeping.origin}: {why} than '{rack}' has here")
    return found


def unkept(plan: Resolved) -> str:
    """Return why a rack has no checkpoints, as far as it can be said before a launch; empty: it
    has.

    Levels that are not the rack's own are built for it.
    """
    if why := outside(plan.config):
        return why
    for task in plan.tasks:
        kind = find_class(task.target, LevelSection)
        if not kind.__module__.startswith(FLOORS):
            # One that cannot be built says so at the launch.
            with suppress(LevelError):
                level = kind(task.context)
                try:
                    Parts(level, task.task)
                except CheckpointError as error:
                    return str(error)
    return ""


def continue_in(segment: Segment, found: Checkpoint) -> None:
    """Fill the segment of a rack that is being launched."""
    fill(segment, found.tick, found.regions, found.memory)
