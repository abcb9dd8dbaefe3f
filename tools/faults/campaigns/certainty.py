"""Early end of a trial, as soon as the verdict on each of its faults is certain."""

from __future__ import annotations

from collections.abc import Sequence

from rack.backplane.fault_table import NEVER
from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.events import Event
from rack.tools.faults.ending import Strike, list_strikes
from rack.tools.faults.judge import Circumstances, Judge, Judgement, find_end


class EarlyEnd:
    """Ends a lockstep trial as soon as no later event can change the verdict on any fault.

    It holds the rack before the ticks at which all verdicts may have become final, first before
    `tick`, at which the last fault begins.

    Attributes:
        is_reached: Whether the trial was ended.
    """

    def __init__(self, rack: Rack, joints: Sequence[str], run: Circumstances, tick: int) -> None:
        self.is_reached = False
        self._rack = rack
        self._joints = joints
        self._run = run
        self._words = rack.segment.words
        self._hold_before(max(tick, rack.begins_at))

    def evaluate_if_held(self) -> None:
        """If the rack is held, end the trial if all verdicts are final, or continue it."""
        tick = self._words[System.HELD] - 1
        if tick < 0 or self.is_reached:
            return
        struck = list_strikes(self._rack.segment, self._joints)
        # The rack has not ended, but the judge needs to know how far it has run.
        events = [*self._rack.events, Event(0, tick, "end", "", "")]
        certain_at = ForesightedJudge(struck, events, self._run).find_certain_tick(tick)
        if certain_at is None:
            # The verdict needs the whole run, so do not hold the rack again.
            self._words[System.HOLD_AT] = 0
        elif certain_at > tick:
            self._hold_before(certain_at)
        else:
            self.is_reached = True
            self._words[System.STOP_TICK] = max(tick, 1)
            self._words[System.HOLD_AT] = 0

    def _hold_before(self, tick: int) -> None:
        """Request that the rack is held before a tick."""
        self._words[System.HOLD_AT] = tick + 1


class ForesightedJudge(Judge):
    """Evaluates faults and also computes when the judgements become final."""

    def find_certain_tick(self, tick: int) -> int | None:
        """Return the tick from which no later event can change a judgement.

        Args:
            tick: Tick before which the rack is held.

        Returns:
            A tick up to `tick` if all judgements are final, a later tick at which to check again,
            or None if they need the whole run.
        """
        latest = tick
        for strike, judgement in zip(self._strikes, self.judge_all().faults, strict=True):
            certain_tick = self._find_fault_certain_tick(strike, judgement, tick)
            if certain_tick is None:
                return None
            latest = max(latest, certain_tick)
        return latest

    def _find_fault_certain_tick(
        self, strike: Strike, judgement: Judgement, tick: int
    ) -> int | None:
        """Return the tick from which one judgement is final.

        The result has the same meaning as that of `find_certain_tick`.
        """
        retry_tick = tick + self._settle
        if strike.began < 0:
            return retry_tick
        if strike.ends >= NEVER:
            return None
        ends = find_end(strike)
        if strike.tick < 0 and ends >= tick:
            return retry_tick
        certain_tick = self._find_last_effect(strike, ends) + 1
        if certain_tick > tick:
            return certain_tick
        # A planner may detect a fault of its plans, or write its next message, at any later time.
        is_open = self._compute_window(strike)[1] >= tick and judgement.seen != "detected"
        return retry_tick if is_open or not judgement.is_recovered else tick
