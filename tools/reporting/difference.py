"""Two runs side by side: the first tick at which what they wrote differs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rack.tools.console.answer import Failure
from rack.tools.recording import Recording


@dataclass(frozen=True)
class Difference:
    """Where two runs part: the release tick of the first message that differs, and its mailbox."""

    tick: int
    mailbox: str


def first_difference(one: Recording, other: Recording) -> Difference | None:
    """Return where two runs part; None when all that both wrote is equal.

    Messages that only the longer run wrote, behind the end of the shorter one, are no difference.
    Raises `Failure` when the two have no mailbox in common, or either lost rows.
    """
    for recording in (one, other):
        lost = sum(recording.lost.values())
        if lost:
            raise Failure(f"{recording.folder}: its recorder lost {lost} rows; where the runs part cannot be told")
    shared = [name for name in one.mailboxes if name in other.mailboxes]
    if not shared:
        raise Failure(f"{one.folder} and {other.folder} have no mailbox in common")
    found = [difference for name in shared if (difference := _parting(one, other, name)) is not None]
    return min(found, key=lambda difference: difference.tick, default=None)


def _parting(one: Recording, other: Recording, mailbox: str) -> Difference | None:
    # The chain covers serial, tick and content of a message and of all before it.
    chains = [recording.signal(mailbox, "chain") for recording in (one, other)]
    length = min(len(chain) for chain in chains)
    differs = np.flatnonzero(chains[0][:length] != chains[1][:length])
    if not len(differs):
        return None
    first = differs[0]
    return Difference(int(min(recording.signal(mailbox, "tick")[first] for recording in (one, other))), mailbox)
