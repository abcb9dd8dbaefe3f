"""Pace of a trial in lockstep: when its faults begin, and when it may end.

A plan leaves enough time after each fault for the slowest detection and recovery. Most faults are
settled much sooner. The rack is therefore held from time to time, and judged: once the newest
fault is settled, the next one begins. Once the verdict on each fault is certain, the trial ends.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rack.backplane.fault_table import NEVER, FaultEntry, FaultTable, Stage
from rack.backplane.words import Block, System
from rack.boards import Rack
from rack.boards.events import Event
from rack.boards.faults.kind import DIED, KINDS
from rack.tools.faults.campaigns.draw import SETTLE_S
from rack.tools.faults.ending import Strike, build_strike, list_strikes
from rack.tools.faults.judge import Circumstances, Judge, Judgement, find_end

REPORTS = ("detection", "miss", "reaction", "recovery")
"""Kinds of events after which a fault is not settled before `SETTLE_S` has passed."""
ASYNCHRONOUS = (DIED, "restart")
"""Codes of events whose ticks depend on the speed of the Rack."""
PATIENCE = 8
"""A fault that is not settled after n ticks is judged again after n / `PATIENCE` ticks."""


class Pacer:
    """Begins the faults of a trial as soon as possible, and ends the trial.

    All decisions depend on ticks alone, so the same plan always gets the same ticks.

    Args:
        rack: Rack of the trial, launched with the faults of the plan.
        joints: Names of the joints.
        run: Facts about the run.
        faults: Faults of the plan, in the order of their ticks.

    Attributes:
        is_over: Whether the trial was ended early.
    """

    def __init__(
        self,
        rack: Rack,
        joints: Sequence[str],
        run: Circumstances,
        faults: Sequence[Mapping[str, Any]],
    ) -> None:
        self.is_over = False
        self._rack = rack
        self._joints = joints
        self._run = run
        self._words = rack.segment.words
        self._table = FaultTable(rack.segment)
        used = [entry for entry in self._table.entries if entry.stage != Stage.FREE]
        self._entries = used[-len(faults) :]
        self._tasks = [rack.segment.get_block(task.name) for task in run.layout.tasks]
        self._faults = faults
        self._hold_before(max(faults[0]["tick"], rack.begins_at))

    @property
    def begin_ticks(self) -> tuple[int, ...]:
        """Tick at which each fault began or is due."""
        return tuple(entry.tick for entry in self._entries)

    def continue_if_held(self) -> None:
        """If the rack is held, begin the next fault or end the trial, and continue."""
        words = self._words
        # The clock may not have noticed yet that it may continue.
        if not 0 < words[System.HOLD_AT] <= words[System.HELD]:
            return
        tick = words[System.HELD] - 1
        # Read all events up to this tick.
        self._rack.watch(0.0)
        # The rack has not ended, but the judge needs to know how far it has run.
        events = [*self._rack.events, Event(0, tick, "end", "", "")]
        waiting = [entry for entry in self._entries if entry.stage == Stage.WAITING]
        if waiting:
            begun = [entry for entry in self._entries if entry.stage != Stage.WAITING]
            newest = max(begun, key=lambda entry: entry.tick, default=waiting[0])
            strike = build_strike(newest, self._run.layout, self._joints)
            judge = ForesightedJudge([strike], events, self._run)
            self._hold_before(self._advance_faults(waiting, judge, tick))
            return
        struck = list_strikes(self._rack.segment, self._joints)
        certain_at = ForesightedJudge(struck, events, self._run).find_certain_tick(tick)
        if certain_at is None:
            # The verdict needs the whole run, so do not hold the rack again.
            words[System.HOLD_AT] = 0
        elif certain_at > tick:
            self._hold_before(certain_at)
        else:
            self.is_over = True
            words[System.STOP_TICK] = max(tick, 1)
            words[System.HOLD_AT] = 0

    def _advance_faults(
        self, waiting: Sequence[FaultEntry], judge: ForesightedJudge, tick: int
    ) -> int:
        """Let the next fault begin before `tick` if the newest one is settled.

        All later faults then begin earlier by the same number of ticks.

        Args:
            waiting: Entries of the faults that have not begun.
            judge: Judge of the newest fault.
            tick: Tick before which the rack is held.

        Returns:
            The next tick before which the rack must be held.
        """
        planned = waiting[0].tick
        if planned > tick:
            begin = tick + judge.quiet_ticks
            if not any(block[Block.LOST] for block in self._tasks):
                settled = judge.find_settled_tick(tick)
                begin = max([settled, *self._list_limits(waiting[0].index)])
            if begin > tick:
                return min(begin, planned)
            self._table.advance_waiting(planned - tick)
        return tick + judge.quiet_ticks

    def _list_limits(self, index: int) -> Iterator[int]:
        """Yield the ticks before which a fault must not begin.

        The planned time must pass between two faults of one mailbox, between two that end the same
        process, and after a fault of the clock. Readers report further damage of a mailbox only
        after a while, restarts are limited, and a slow task reports late that ticks were skipped.
        """
        faults = self._faults
        targets = _list_targets(faults[index])
        for number, entry in enumerate(self._entries[:index]):
            is_of_clock = number == index - 1 and KINDS[faults[number]["kind"]].where == "clock"
            if is_of_clock or not targets.isdisjoint(_list_targets(faults[number])):
                yield entry.tick + faults[number + 1]["tick"] - faults[number]["tick"]

    def _hold_before(self, tick: int) -> None:
        """Request that the rack is held before a tick."""
        self._words[System.HOLD_AT] = tick + 1


def _list_targets(fault: Mapping[str, Any]) -> set[str]:
    """Return the mailbox of a fault of messages, and the task whose process a fault ends."""
    kind = KINDS[fault["kind"]]
    targets = {fault.get("mailbox", fault["board"])} if kind.takes_mailbox else set()
    return targets | ({fault["board"]} if kind.consequence.ends_process else set())


class ForesightedJudge(Judge):
    """Evaluates faults and also computes when they are settled and when judgements are final."""

    @property
    def quiet_ticks(self) -> int:
        """Number of ticks without reports after which a fault is settled."""
        return self._layout.to_ticks(SETTLE_S)

    def find_certain_tick(self, tick: int) -> int | None:
        """Return the first tick at which all judgements are final, whatever happens later.

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

    def find_settled_tick(self, tick: int) -> int:
        """Return the first tick at which the fault of this judge is settled. It must have only one.

        A fault is settled if it is over, was detected within its bound, has all reactions that it
        requires, is recovered from, and nothing has been reported for `SETTLE_S` since.

        Args:
            tick: Tick before which the rack is held.

        Returns:
            A tick up to `tick` if the fault is settled, otherwise a later tick at which to check
            again.
        """
        (strike,), (judgement,) = self._strikes, self.judge_all().faults
        ends = find_end(strike)
        if _is_handled(judgement):
            return max(ends, self._find_last_report()) + self.quiet_ticks
        if tick <= ends < NEVER:
            return ends + self.quiet_ticks
        return tick + max(self.quiet_ticks, (tick - strike.began) // PATIENCE)

    def _find_last_report(self) -> int:
        """Return the tick of the last report. A handled fault has one."""
        return max(
            event.tick
            for event in self._events
            if event.kind in REPORTS and event.code not in ASYNCHRONOUS
        )

    def _find_fault_certain_tick(
        self, strike: Strike, judgement: Judgement, tick: int
    ) -> int | None:
        """Return the first tick at which one judgement is final.

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
        # Once the rack has recovered, only late reports of the fault's last effects may follow.
        quiet_tick = certain_tick - self._compute_recovery(strike)
        if tick < quiet_tick:
            return quiet_tick
        if _is_handled(judgement):
            certain_tick = max(quiet_tick, self._find_last_report() + self._settle + 1)
        if certain_tick > tick:
            return min(certain_tick, retry_tick)
        # A planner may detect a fault of its plans, or write its next message, at any later time.
        is_open = self._compute_window(strike)[1] >= tick and judgement.seen != "detected"
        return retry_tick if is_open or not judgement.is_recovered else tick


def _is_handled(judgement: Judgement) -> bool:
    """Return True if a fault was detected in time, with all its reactions, and recovered from."""
    return (
        judgement.seen == "detected"
        and judgement.is_within
        and judgement.is_recovered
        and not judgement.lacking
        and not judgement.is_latched
    )
