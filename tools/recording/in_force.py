"""Finds the message visible at any tick of a recorded run, and ticks at which a trigger fires."""

from __future__ import annotations

from functools import cache

import numpy as np

from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Trigger


class VisibleMessages:
    """Finds the newest message that is visible in a mailbox at a given tick of a run.

    The messages of a mailbox are loaded when it is first used.
    """

    def __init__(self, recording: Recording) -> None:
        self._load_rows = cache(recording.read_rows)

    def find_row(self, mailbox: str, tick: int) -> np.ndarray | None:
        """Return the newest row of a mailbox that is visible at `tick`, or None."""
        rows = self._load_rows(mailbox)
        visible = np.flatnonzero(rows["visible_at"] <= tick)
        return rows[visible[-1]] if len(visible) else None

    def find_trigger_ticks(self, condition: Trigger) -> np.ndarray:
        """Find the ticks at which a condition becomes true for the readers of its mailbox.

        Returns:
            Ticks at which a message becomes visible that meets the condition, although the previous
            message does not. In ascending order, shape (ticks,).
        """
        rows = self._load_rows(condition.signal.mailbox)
        holds = condition.evaluate_messages(rows["message"])
        held_before = np.concatenate((np.zeros(1, bool), holds[:-1]))
        ticks: np.ndarray = np.unique(rows["visible_at"][holds & ~held_before])
        return ticks
