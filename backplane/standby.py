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
from dataclasses import dataclass, replace

from rack.backplane.address_map import CLOCK, CLOCK_STANDBY
from rack.backplane.checked import to_enum
from rack.backplane.layout import Layout
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
        since_s: Simulated time of that tick.
        reason: Why the active copy has taken over: the name of a `HandOver` in lower case, "none"
            if no other was active before.
        hand_overs: Number of hand-overs.
        line: All of it as text.
    """

    name: str
    copies: tuple[Copy, ...]
    since_tick: int
    since_s: float
    reason: str
    hand_overs: int
    line: str

    @property
    def active(self) -> Copy:
        """The copy that writes the mailboxes."""
        return next((copy for copy in self.copies if copy.is_active), self.copies[0])


def find_original(layout: Layout, copy: str) -> str:
    """Return the name of the task, or of the clock, that a process copies. It may be its own."""
    return CLOCK if copy == CLOCK_STANDBY else layout.find_first_copy(copy)


def list_standbys(segment: Segment) -> tuple[ReplicatedTask, ...]:
    """Return all tasks that have standbys, with the state of each copy."""
    return tuple(_read_task(segment, board) for board in segment.layout.replicated_tasks)


def _read_task(segment: Segment, name: str) -> ReplicatedTask:
    """Return the state of one task with standbys."""
    words = segment.get_block(name)
    copies = []
    others = []
    for number, spec in enumerate(segment.layout.list_copies(name)):
        block = segment.get_block(spec.name)
        is_active, is_lost = number == words[Block.ACTIVE], bool(block[Block.LOST])
        aligned = block[Block.ALIGNED] - 1
        aligned_since = None if aligned < 0 or is_active or is_lost else aligned
        pid = block[Block.PID]
        copies.append(Copy(spec.name, spec.slot, spec.core, pid, is_active, is_lost, aligned_since))
        if not is_active:
            ready = "not ready" if aligned_since is None else f"ready since tick {aligned_since}"
            others.append(f"; {spec.name} {'lost' if is_lost else ready}")
    reason = to_enum(HandOver, words[Block.HAND_OVER])
    since_tick = words[Block.ACTIVE_SINCE]
    since_s = since_tick * segment.layout.clock_ns * 1e-9
    why = f" since tick {since_tick} ({since_s:g} s): {HAND_OVER_REASONS[reason]}"
    task = ReplicatedTask(
        name, tuple(copies), since_tick, since_s, reason.name.lower(), words[Block.HAND_OVERS], ""
    )
    head = f"'{name}': {task.active.name} active{why * bool(reason)}"
    return replace(task, line="".join([head, *others]))
