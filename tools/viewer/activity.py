"""What each level is at: its state and its command as lanes, its errors as log lines."""

from __future__ import annotations

import numpy as np
import rerun as rr

from rack.backplane.layout import MailboxSpec
from rack.backplane.message import State
from rack.levels.messages import Verb
from rack.tools.viewer.blocks import Block, Changes
from rack.tools.viewer.lanes import style_lane, write_spans
from rack.tools.viewer.palette import STATES
from rack.tools.viewer.stream import Stream

LEVELS, LOG = "levels", "log"


class Activity:
    """Writes the state in a level's statuses, and each error once."""

    def __init__(self, stream: Stream, mailbox: MailboxSpec) -> None:
        self._stream, self._board = stream, mailbox.name.partition(".")[0]
        self._lane = (LEVELS, self._board, "state")
        self._states, self._errors = Changes(), Changes()
        style_lane(stream, self._lane, STATES)

    def write(self, block: Block) -> None:
        """Write what changed."""
        messages = block.messages
        rows = self._states.rows(messages["state"])
        if len(rows):
            names = [State(int(state)).name.lower() for state in messages["state"][rows]]
            write_spans(self._stream, self._lane, _times(self._stream, block, rows), names)
        for row in self._errors.rows(messages["error"]):
            if messages["error"][row]:
                reason = messages["reason"][row].decode("ascii", "replace")
                line = rr.TextLog(f"{self._board}: {reason or 'error ' + str(messages['error'][row])}", level="ERROR")
                self._stream.at(int(block.ticks[row]), int(block.stamps_ns[row]), (LOG, "levels"), line)


class Commanded:
    """Writes the serial of the command that a mailbox holds."""

    def __init__(self, stream: Stream, mailbox: MailboxSpec) -> None:
        board, _, port = mailbox.name.partition(".")
        self._stream, self._lane, self._serials = stream, (LEVELS, board, port), Changes()

    def write(self, block: Block) -> None:
        """Write what changed."""
        serials = block.messages["id"]
        rows = self._serials.rows(serials)
        if len(rows):
            names = [f"command {serial}" if serial else "" for serial in serials[rows].tolist()]
            write_spans(self._stream, self._lane, _times(self._stream, block, rows), names)


class Moves:
    """Writes the elemental move under way, of `MOVE_STATUS`es, by its verb."""

    def __init__(self, stream: Stream, mailbox: MailboxSpec) -> None:
        self._stream, self._lane = stream, (LEVELS, mailbox.name.partition(".")[0], "move")
        self._moves = Changes()

    def write(self, block: Block) -> None:
        """Write what changed."""
        messages = block.messages
        rows = self._moves.rows(messages["current"])
        if len(rows):
            names = [_verb(int(verb)) if at else "" for at, verb in messages[["current", "verb"]][rows].tolist()]
            write_spans(self._stream, self._lane, _times(self._stream, block, rows), names)


def _verb(verb: int) -> str:
    return Verb(verb).name.lower().replace("_", " ")


def _times(stream: Stream, block: Block, rows: np.ndarray) -> list[rr.TimeColumn]:
    return stream.times.columns(block.ticks[rows], block.stamps_ns[rows])
