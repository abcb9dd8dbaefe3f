"""When which level of a run was kept from its own work: by an operator, or by what it said itself."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from rack.backplane.layout import Layout
from rack.backplane.message import State
from rack.levels.operator import Operation
from rack.tools.recording import Recording

OWN = "holding"
"""What keeps a level that gives the reason itself."""


def holds(recording: Recording, layout: Layout) -> list[dict[str, Any]]:
    """Return every hold, the earliest first; `until_s` is None where it lasted to the end of the run.

    `by` is "operator", and `why` what was commanded; or it is "holding", and `why` the reason that the level gave last.
    """
    tick_s = layout.clock_ns * 1e-9
    found = []
    for mailbox in recording.mailboxes:
        level, _, port = mailbox.partition(".")
        if port != "status" or "state" not in recording.fields(mailbox):
            continue
        ticks, own = recording.signal(mailbox, "tick"), recording.signal(mailbox, "state") == State.HOLDING
        standing = np.zeros(len(ticks), int)
        if "standing" in recording.fields(mailbox):
            standing = recording.signal(mailbox, "standing").astype(int)
        # An operator comes before what the level itself says of it.
        what = np.where(standing > 0, standing, -own.astype(int))
        for first, end in _stretches(what):
            is_operators = what[first] > 0
            said = (
                Operation(what[first]).name.lower()
                if is_operators
                else str(recording.signal(mailbox, "reason")[end - 1])
            )
            since, until = int(ticks[first]), int(ticks[end]) if end < len(ticks) else None
            found.append(
                {
                    "level": level,
                    "by": "operator" if is_operators else OWN,
                    "why": said,
                    "since_s": round(since * tick_s, 6),
                    "until_s": None if until is None else round(until * tick_s, 6),
                    "lasted_s": round(((int(ticks[-1]) if until is None else until) - since) * tick_s, 6),
                }
            )
    return sorted(found, key=lambda hold: (hold["since_s"], hold["level"]))


def _stretches(what: np.ndarray) -> list[tuple[int, int]]:
    """Return the stretches of equal numbers that are not 0, each as its first place and the one that follows it."""
    borders = [0, *(np.flatnonzero(np.diff(what)) + 1).tolist(), len(what)]
    return [(first, end) for first, end in pairwise(borders) if first < end and what[first]]
