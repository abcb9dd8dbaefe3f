"""Launching a rack that takes checkpoints, or continues from one."""

from __future__ import annotations

from rack.backplane.segment import Segment
from rack.boards.checkpoint.format import Checkpoint, layout_hash, read
from rack.boards.checkpoint.memory import fill
from rack.boards.config.resolved import Resolved
from rack.boards.errors import CheckpointError
from rack.boards.wiring import Keeping


def origin(plan: Resolved, keeping: Keeping) -> Checkpoint | None:
    """Return the checkpoint from which a rack continues, if it is to.

    Raises `CheckpointError` for a rack that has none, and for a checkpoint of another rack.
    """
    rack = plan.config.name
    if plan.config.clock.mode != "lockstep":
        raise CheckpointError(f"rack '{rack}': checkpoints are taken in lockstep; add --lockstep")
    if plan.hosts:
        names = ", ".join(f"'{host.board}'" for host in plan.hosts)
        raise CheckpointError(f"rack '{rack}' has no checkpoints: {names}: a host program's state")
    if keeping.origin is None:
        return None
    found = read(keeping.origin)
    if found.layout != layout_hash(plan.layout):
        why = "of a rack with other tasks, mailboxes or messages"
        raise CheckpointError(f"{keeping.origin}: {why} than '{rack}' has here")
    return found


def continue_in(segment: Segment, found: Checkpoint) -> None:
    """Fill the segment of a rack that is being launched."""
    fill(segment, found.tick, found.regions, found.memory)
