"""The end of a trial as soon as the verdict on each of its faults is certain."""

from __future__ import annotations

from collections.abc import Sequence

from rack.backplane.fault_table import NEVER
from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.events import Event
from rack.tools.faults.ending import Strike, strikes
from rack.tools.faults.judge import Circumstances, Judge, Judgement, end_of


class Certainty:
    """Ends a trial in lockstep as soon as nothing that follows can change the verdict on a fault.

    It holds the rack before the ticks at which that may be so. `is_reached`: it has ended the
    trial.
    """

    def __init__(self, rack: Rack, joints: Sequence[str], run: Circumstances) -> None:
        self.is_reached = False
        self._rack = rack
        self._joints = joints
        self._run = run
        self._words = rack.segment.words
        self._hold(max(0, rack.begins_at))

    def look(self) -> None:
        """Judge, if the rack is held; then let it go on, or end."""
        tick = self._words[System.HELD] - 1
        if tick < 0 or self.is_reached:
            return
        struck = strikes(self._rack.segment, self._joints)
        certain_at = certain_from(struck, self._rack.events, self._run, tick)
        if certain_at is None:
            # It runs to its end.
            self._words[System.HOLD_AT] = 0
        elif certain_at > tick:
            self._hold(certain_at)
        else:
            self.is_reached = True
            self._words[System.STOP_TICK] = max(tick, 1)
            self._words[System.HOLD_AT] = 0

    def _hold(self, tick: int) -> None:
        self._words[System.HOLD_AT] = tick + 1


def certain_from(
    strikes: Sequence[Strike], events: Sequence[Event], run: Circumstances, tick: int
) -> int | None:
    """Return the tick from which nothing that happens later can change the judgement of a run's
    faults, as far as is known before `tick`; a later one at which to ask again; None: its end.
    """
    now = Event(0, tick, "end", "", "")
    return _ForesightedJudge(strikes, [*events, now], run).certain_from(tick)


class _ForesightedJudge(Judge):
    def certain_from(self, tick: int) -> int | None:
        """Return the tick as `certain_from` does, asked before `tick`."""
        latest = tick
        for strike, found in zip(self._strikes, self.verdict().faults, strict=True):
            closes = self._closes(strike, found, tick)
            if closes is None:
                return None
            latest = max(latest, closes)
        return latest

    def _closes(self, strike: Strike, found: Judgement, tick: int) -> int | None:
        """Return the tick from which the judgement of a fault is certain, as in `certain_from`."""
        again = tick + self._settle
        if strike.began < 0:
            return again
        if strike.ends >= NEVER:
            return None
        ends = end_of(strike)
        if strike.tick < 0 and ends >= tick:
            return again
        closes = self._last_trace(strike, ends) + 1
        if closes > tick:
            return closes
        # Its writer may find the fault of a plan at any later time, or have something to write.
        is_open = self._window(strike)[1] >= tick and found.seen != "detected"
        return again if is_open or not found.is_recovered else tick
