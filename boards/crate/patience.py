"""Waits that are reported to the user if they take long, during a launch or for another rack."""

from __future__ import annotations

import math
import time

from rack.backplane.segment import Segment
from rack.boards.crate.line import CrateLine
from rack.boards.crate.requests import Compiling, Opened, PreloadFailed, Preloading
from rack.boards.errors import LaunchError
from rack.boards.events import Journal
from rack.boards.lan.awaited import find_waits

COMPILE_S = 300.0
"""Time limit for compiling one function: thirty times the longest measured on an idle machine."""
PATIENCE_S = 2.0
"""Time after which a wait is reported. The report is repeated each time the wait has doubled."""


class ReportedWait:
    """A wait with a time limit, which is reported as an event if it takes long.

    Args:
        journal: Journal to which a long wait is reported.
        limit_s: Longest time to wait in s.
    """

    def __init__(self, journal: Journal, limit_s: float) -> None:
        self._journal = journal
        self.limit_s = self._limit_s = limit_s
        self._began = time.monotonic()
        self._report_s = PATIENCE_S

    @property
    def is_over(self) -> bool:
        """Whether the time limit is exceeded."""
        return self._waited_s > self._limit_s

    @property
    def left_s(self) -> float:
        """Time in s until the next report is due or the time limit is reached."""
        return max(0.0, min(self._report_s, self._limit_s) - self._waited_s)

    def restart_limit(self, limit_s: float) -> None:
        """Replace the time limit by `limit_s` from now. The times of reports do not change."""
        self.limit_s = limit_s
        self._limit_s = self._waited_s + limit_s

    def report_if_due(self, doing: str) -> None:
        """Report the wait if a report is due, with a clause such as "the crate is starting"."""
        if self._waited_s >= self._report_s:
            self._journal.add_event("waiting", "", f"{doing}, {self._waited_s:.0f} s so far")
            self._report_s *= 2.0

    @property
    def _waited_s(self) -> float:
        """Time in s since the wait began."""
        return time.monotonic() - self._began


class PeerWaitReporter:
    """Reports the racks for which adapters wait in lockstep, where waits have no time limit."""

    def __init__(self, segment: Segment, journal: Journal) -> None:
        self._segment = segment
        self._journal = journal
        self._patience: ReportedWait | None = None

    def report_if_due(self) -> None:
        """Report the racks for which adapters wait, if a report is due."""
        waits = list(find_waits(self._segment))
        if not waits:
            self._patience = None
            return
        self._patience = self._patience or ReportedWait(self._journal, math.inf)
        for board, why in waits:
            self._patience.report_if_due(f"'{board}' {why}")


def await_open_segment(crate: CrateLine, journal: Journal, limit_s: float) -> int:
    """Wait until the crate has preloaded the levels and opened the segment.

    Args:
        crate: The crate.
        journal: Journal to which a long wait is reported.
        limit_s: Time limit in s for each class that is preloaded.

    Returns:
        Tick of the snapshot from which the rack continues. -1 if there is none.

    Raises:
        LaunchError: A class cannot be preloaded, or the time limit is exceeded.
    """
    patience = ReportedWait(journal, limit_s)
    doing = "the crate is starting"
    while not patience.is_over:
        if not crate.line.poll(patience.left_s):
            patience.report_if_due(doing)
            continue
        match crate.receive_message():
            case Opened(tick):
                return tick
            case Preloading(kind):
                patience = ReportedWait(journal, limit_s)
                doing = f"preloading '{kind}'"
            case Compiling(function):
                patience.restart_limit(COMPILE_S)
                doing = f"compiling '{function}', which is kept for later launches"
            case PreloadFailed(kind, why):
                raise LaunchError(f"'{kind}' cannot be preloaded: {why}")
            case None:
                raise crate.build_error("the crate has ended")
    raise crate.build_error(f"{doing}: not done within {patience.limit_s:g} s")
