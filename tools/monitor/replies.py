"""Follows a command to a level of a running rack in the statuses of the level."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rack.backplane.layout import MailboxSpec
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.message import decode_text
from rack.backplane.segment import Segment
from rack.backplane.words import Block
from rack.levels.operator import CLOCK_OPERATIONS, DRIVE_OPERATIONS, SETTINGS, Answer

REPLY_CYCLES = 4
"""Number of a level's cycles within which it replies.

One reads the command, one makes the reply visible, one may answer another operator, and one may be
under way.
"""
NO_CYCLE_S = 1.0
"""Simulated time without a completed cycle after which a wait for a level ends."""

Fate = Literal["waiting", "given", "taken", "done", "refused", "superseded"]
"""State of a command."""


@dataclass(frozen=True)
class Reply:
    """A command to a level, and the level's reaction to it.

    `given`, `taken_up` and `done` are the ticks at which the command was given, accepted and
    completed, or -1 if this has not happened.

    Attributes:
        serial: Serial number of the command. 0 while the command waits.
        fate: "waiting" if the rack is held, "given" until the level answers. It stays "given" if
            the level's status has no fields for answers.
        objection: Why the command was refused.
        waits: Why a waiting command waits. Empty for other commands.
    """

    serial: int
    level: str
    text: str
    given: int
    fate: Fate = "given"
    taken_up: int = -1
    done: int = -1
    objection: str = ""
    waits: str = ""

    @property
    def worked(self) -> bool:
        """True unless the command was refused."""
        return self.fate != "refused"

    @property
    def is_in_force(self) -> bool:
        """True if the command is known to be in force."""
        return self.fate in ("taken", "done")

    @property
    def line(self) -> str:
        """Description of the reply in one line."""
        if self.fate == "waiting":
            return f"command to '{self.level}', {self.text}: {self.waits}"
        ends = {
            "given": "; the status of this level does not answer operators",
            "taken": f", taken up at tick {self.taken_up}",
            "done": f", taken up at tick {self.taken_up}, done at tick {self.done}",
            "refused": f", refused at tick {self.taken_up}: {self.objection}",
            "superseded": ", superseded by a newer command",
        }
        return (
            f"command {self.serial} to '{self.level}', {self.text}: given at tick"
            f" {self.given}{ends[self.fate]}"
        )


def find_answering_status(segment: Segment, level: str) -> MailboxSpec | None:
    """Find the status mailbox of a level. None if it has no fields for replies to operators."""
    return next(
        (
            box
            for box in segment.layout.mailboxes
            if box.name == f"{level}.status"
            and {"order", "answer", "objection"} <= {field.name for field in box.fields}
        ),
        None,
    )


class ReplyReader:
    """Reads the statuses of a level for its reply to one command.

    A newer command supersedes this one as soon as the level has accepted it. There are two
    exceptions: settings supersede nothing, and commands to the drives supersede only each other.

    Attributes:
        reply: The reply according to the statuses read so far.
    """

    def __init__(self, segment: Segment, status: MailboxSpec, reply: Reply) -> None:
        self._ring = MailboxRing(segment, status.name)
        self._given = MailboxRing(segment, f"{reply.level}.operator")
        self._kinds: dict[int, int] = {}
        """Kind of each command given to the level, keyed by serial number."""
        self.reply = reply

    def read_statuses(self) -> Reply:
        """Read the statuses written since the last call."""
        rows = self._ring.read_new_rows().rows
        # Read the commands after the statuses: a command is always older than its answer.
        commands = self._given.read_new_rows().rows["message"]
        self._kinds.update(zip(commands["id"].tolist(), commands["what"].tolist(), strict=True))
        for row in rows:
            if self.reply.fate in ("given", "taken"):
                self.reply = self._update_reply(int(row["tick"]), row["message"])
        return self.reply

    def _update_reply(self, tick: int, status: np.void) -> Reply:
        """Return the reply updated by one status, which was written at `tick`."""
        reply = self.reply
        answer = status["answer"]
        if status["order"] == reply.serial:
            taken_up = tick if reply.taken_up < 0 else reply.taken_up
            if answer == Answer.REFUSED:
                objection = decode_text(status["objection"])
                return replace(reply, fate="refused", taken_up=taken_up, objection=objection)
            if answer == Answer.DONE:
                return replace(reply, fate="done", taken_up=taken_up, done=tick)
            return replace(reply, fate="taken", taken_up=taken_up)
        is_newer = status["order"] > reply.serial and answer in (Answer.TAKEN, Answer.DONE)
        if is_newer and self._supersedes(status["order"]):
            return replace(reply, fate="superseded")
        return reply

    def _supersedes(self, serial: int) -> bool:
        """Return whether a newer accepted command supersedes this one."""
        kind = self._kinds.get(serial)
        if kind in (*SETTINGS, *CLOCK_OPERATIONS):
            return False
        return (
            kind not in DRIVE_OPERATIONS or self._kinds.get(self.reply.serial) in DRIVE_OPERATIONS
        )


class ReplyDeadline:
    """Detects that a level has failed to answer a command in time.

    It counts cycles instead of ticks, because a level on a busy machine skips some of its releases.
    """

    def __init__(self, segment: Segment, status: MailboxSpec) -> None:
        self._block = segment.get_block(status.writer)
        self._bound = self._block[Block.CYCLES] + REPLY_CYCLES
        self._cycles = -1
        self._since = 0
        shortest = segment.layout.to_ticks(NO_CYCLE_S)
        self._silent = max(REPLY_CYCLES * status.every, shortest)

    def explain_missing_reply(self, tick: int) -> str:
        """Return why the answer is overdue. Empty before the deadline."""
        cycles = self._block[Block.CYCLES]
        if cycles != self._cycles:
            self._cycles = cycles
            self._since = tick
        if cycles > self._bound:
            return f"has not answered within {REPLY_CYCLES} cycles"
        if tick - self._since > self._silent:
            return f"has not answered, and has not completed a cycle since tick {self._since}"
        return ""
