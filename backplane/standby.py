"""Standbys: extra copies of a task. If the active copy is lost, one of them replaces it.

All copies run the same level on the same inputs, released at the same ticks. One of them is active
and writes the mailboxes. The others hold their messages back and compare them with those of the
active copy. `list_standbys` returns the state of all copies, for tools:

    for task in list_standbys(segment):
        print(task.name, task.active.name, task.since_tick, task.reason)

The words of the hand-over are in the control block of the first copy, which has the name of the
task. They change only while the changing process holds the kernel's lock on `Block.ACTIVE`. It ends
with the process, so a copy that is killed during a hand-over does not keep others from repeating
it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rack.backplane.checked import to_enum
from rack.backplane.segment import Segment
from rack.backplane.words import Block, HandOver

HAND_OVER_REASONS: Mapping[HandOver, str] = {
    HandOver.NONE: "no other copy was active before",
    HandOver.LOST: "the active copy was lost",
    HandOver.STOPPED: "the active copy was stopped by a signal",
    HandOver.LATE: "the active copy had not finished its cycle",
    HandOver.COMMANDED: "an operator has switched",
    HandOver.STRAYED: "the active copy differed from two others",
}
"""Reasons for hand-overs as text."""


@dataclass(frozen=True)
class Copy:
    """One copy of a task.

    Attributes:
        name: Name of the copy, as in "servo.standby".
        slot: Slot of its board.
        core: Core of its process.
        pid: Its process.
        is_active: Whether it writes the mailboxes of the task.
        is_lost: Whether its process was lost and has not returned yet.
        aligned_since: Tick since which its messages equal those of the active copy. None before the
            first comparison, while they differ, and for the active copy.
    """

    name: str
    slot: int
    core: int
    pid: int
    is_active: bool
    is_lost: bool
    aligned_since: int | None


@dataclass(frozen=True)
class ReplicatedTask:
    """A task with standbys.

    Attributes:
        name: Name of the task.
        copies: Its copies, in their order.
        since_tick: First tick in which the active copy wrote. 0 if it was active from the start.
        reason: Why the active copy has taken over: the name of a `HandOver` in lower case, "none"
            if no other was active before.
        hand_overs: Number of hand-overs.
        line: All of it as text.
    """

    name: str
    copies: tuple[Copy, ...]
    since_tick: int
    reason: str
    hand_overs: int
    line: str

    @property
    def active(self) -> Copy:
        """The copy that writes the mailboxes."""
        return next((copy for copy in self.copies if copy.is_active), self.copies[0])


def list_standbys(segment: Segment) -> tuple[ReplicatedTask, ...]:
    """Return all tasks that have standbys, with the state of each copy."""
    layout = segment.layout
    boards = dict.fromkeys(task.board for task in layout.tasks if task.role == "standby")
    return tuple(_read_task(segment, board) for board in boards)


def _read_task(segment: Segment, name: str) -> ReplicatedTask:
    """Return the state of one task with standbys."""
    words = segment.get_block(name)
    copies = []
    for number, spec in enumerate(segment.layout.list_copies(name)):
        block = segment.get_block(spec.name)
        is_active = number == words[Block.ACTIVE]
        aligned = block[Block.ALIGNED] - 1
        is_aligned = aligned >= 0 and not is_active and not block[Block.LOST]
        copies.append(
            Copy(
                spec.name,
                spec.slot,
                spec.core,
                block[Block.PID],
                is_active,
                bool(block[Block.LOST]),
                aligned if is_aligned else None,
            )
        )
    reason = to_enum(HandOver, words[Block.HAND_OVER])
    hand_overs = words[Block.HAND_OVERS]
    since_tick = words[Block.ACTIVE_SINCE]
    parts = [f"{copy.name} {_describe_copy(copy)}" for copy in copies]
    since = f" since tick {since_tick}: {HAND_OVER_REASONS[reason]}" if hand_overs else ""
    line = f"'{name}': {', '.join(parts)}{since}"
    return ReplicatedTask(name, tuple(copies), since_tick, reason.name.lower(), hand_overs, line)


def _describe_copy(copy: Copy) -> str:
    """Return the state of a copy."""
    if copy.is_active:
        return "active"
    return "lost" if copy.is_lost else "not ready" if copy.aligned_since is None else "ready"
