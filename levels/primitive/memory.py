"""What the executor must not forget: enough of its last messages to go on after its board has died."""

from __future__ import annotations

from dataclasses import dataclass

from rack.levels.level import Ports


@dataclass
class Memory:
    """Newest segment done, segment that was interrupted (0: none) and the part of its path behind, object held, and
    what the gripper was told (m, N).
    """

    done: int = 0
    interrupted: int = 0
    progress: float = 0.0
    held: int | None = None
    opening: float = 0.0
    force: float = 0.0


def recall(read: Ports) -> Memory | None:
    """Return what the level's own last messages say; None when it never had anything to remember."""
    status, command = read.last_status, read.last_command
    if not (status.is_there and command.is_there and command.value.id):
        return None
    return Memory(
        done=status.value.done,
        interrupted=status.value.current,
        progress=status.value.progress,
        held=status.value.held if status.value.held >= 0 else None,
        opening=command.value.opening,
        force=command.value.force,
    )
