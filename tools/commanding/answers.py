"""Following a level's status, message by message, for what it says to one command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rack.backplane.layout import MailboxSpec
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.segment import Segment
from rack.levels.operator import Answer
from rack.tools.commanding.told import Told


def answering(segment: Segment, level: str) -> MailboxSpec | None:
    """Return the status mailbox of a level; None where its status does not answer operators."""
    boxes = [box for box in segment.layout.mailboxes if box.name == f"{level}.status"]
    return next((box for box in boxes if {"order", "answer", "objection"} <= {f.name for f in box.fields}), None)


class Answers:
    """Keeps what a level's statuses say to a command, from the first that knows it."""

    def __init__(self, segment: Segment, status: MailboxSpec, told: Told) -> None:
        self._ring = MailboxRing(segment, status.name)
        self.told = told

    def look(self) -> Told:
        """Take in the statuses written since the last call."""
        rows = self._ring.drain().rows
        orders, answers = rows["message"]["order"], rows["message"]["answer"]
        mine = orders == self.told.serial
        if self.told.taken_up < 0 and mine.any():
            self._take_up(rows[int(np.argmax(mine))])
        done = mine & (answers == Answer.DONE)
        if self.told.fate == "taken" and done.any():
            self.told = replace(self.told, fate="done", done=int(rows["tick"][int(np.argmax(done))]))
        if self.told.fate == "taken" and (late := mine & (answers == Answer.REFUSED)).any():
            self._refuse(rows[int(np.argmax(late))])
        if self.told.fate in ("given", "taken") and (orders > self.told.serial).any():
            self.told = replace(self.told, fate="overtaken")
        return self.told

    def _take_up(self, row: np.void) -> None:
        self.told = replace(self.told, fate="taken", taken_up=int(row["tick"]))
        if row["message"]["answer"] == Answer.REFUSED:
            self._refuse(row)

    def _refuse(self, row: np.void) -> None:
        objection = row["message"]["objection"].decode("ascii", "replace")
        self.told = replace(self.told, fate="refused", objection=objection)
