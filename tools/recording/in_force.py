"""Finds the messages that are visible at any tick of a recorded run, and trigger ticks."""

from __future__ import annotations

import numpy as np

from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Trigger


class VisibleMessages:
    """The messages of a run by the tick at which readers see them. Mailboxes load on first use."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._rows: dict[str, np.ndarray] = {}

    def find_row(self, mailbox: str, tick: int) -> np.ndarray | None:
        """Return the newest row of a mailbox that is visible at `tick`, or None if none is."""
        rows = self._load_rows(mailbox)
        visible = np.flatnonzero(rows["visible_at"] <= tick)
        return rows[visible[-1]] if len(visible) else None

    def find_trigger_ticks(self, condition: Trigger) -> np.ndarray:
        """Find the ticks at which readers see a condition become true.

        Returns:
            Ticks, shape (times,), earliest first. In the message before each of them the condition
            was false.
        """
        rows = self._load_rows(condition.signal.mailbox)
        holds = condition.evaluate_messages(rows["message"])
        held_before = np.concatenate((np.zeros(1, bool), holds[:-1]))
        ticks: np.ndarray = np.unique(rows["visible_at"][holds & ~held_before])
        return ticks

    def _load_rows(self, mailbox: str) -> np.ndarray:
        """Return all rows of a mailbox, from memory after the first call."""
        if mailbox not in self._rows:
            self._rows[mailbox] = self._recording.read_rows(mailbox)
        return self._rows[mailbox]
