"""What became of each fault of a trial: struck, found, within its bound, reacted to, recovered from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from backplane.fault_table import Injection
from backplane.layout import Layout
from boards.events import Event
from boards.faults.bounds import RACK_NS, bound_ticks, cycle_ticks
from boards.faults.kinds import KINDS, NUMBERS
from tools.campaign.aftermath import aftermath
from tools.campaign.detection import MAILBOX_ALARMS, Detection, LeftOut, candidates, fits
from tools.campaign.ending import Strike
from tools.campaign.plan import EXTERNAL
from tools.campaign.shape import SIZED, judged_size

Seen = Literal["detected", "missed", "not struck"]
Bound = Callable[[Strike, str | None], int | None]
"""Ticks in which a fault must be found, by a reader or, None, by whoever else."""

AFTERMATH_S = 1.5
"""Simulated time behind a fault's end, and its recovery, in which detections may still be its consequence."""


NEIGHBOURS_CYCLES = 4
"""Cycles of a task that died within which its neighbours must know."""


@dataclass(frozen=True)
class Judgement:
    """What became of one fault. Delays, bounds and recovery are ticks, `cycle` the ticks of the task's cycle.

    `is_judged`: False for a size below the one from which its kind must be seen. `recovery` is the time from the strike
    until everything that was done about it is undone; None: nothing was done, or it was not undone.
    """

    kind: str
    board: str
    mailbox: str
    joint: str
    size: float | None
    began: int
    struck: int
    seen: Seen
    is_judged: bool
    cycle: int
    found_by: str = ""
    found_as: str = ""
    delay: int | None = None
    delay_ms: float | None = None
    bound: int | None = None
    bound_ms: float | None = None
    is_within: bool = False
    reactions: tuple[str, ...] = ()
    is_recovered: bool = True
    recovery: int | None = None


@dataclass(frozen=True)
class Verdict:
    """The judgements of a trial, and what it found that no fault explains."""

    faults: tuple[Judgement, ...]
    unexplained: tuple[Event, ...]


def judge(
    strikes: Sequence[Strike], events: Sequence[Event], layout: Layout, offset_ns: int, lockstep: bool = False
) -> Verdict:
    """Judge the faults of a run by what happened in it.

    `offset_ns` turns CLOCK_MONOTONIC into the events' time. One event is the detection of one fault: of two
    that it fits, of the one that struck first and is not found yet.
    """
    return _Judge(strikes, events, layout, offset_ns, lockstep).verdict()


class _Judge:
    def __init__(
        self, strikes: Sequence[Strike], events: Sequence[Event], layout: Layout, offset_ns: int, lockstep: bool
    ) -> None:
        self._strikes = sorted(strikes, key=lambda s: (s.tick if s.tick >= 0 else s.began, s.fault))
        self._events, self._layout, self._offset_ns, self._lockstep = events, layout, offset_ns, lockstep
        self._bound = _bound_in(layout)
        self._left_out = LeftOut(events)
        self._last = max((event.tick for event in events), default=0)
        self._settle = round(AFTERMATH_S * 1e9 / layout.clock_ns)

    def verdict(self) -> Verdict:
        used: set[int] = set()
        judged, explained = [], []
        for place, strike in enumerate(self._strikes):
            found = self._detections(strike, used)
            best = min(found, key=lambda detection: detection.order, default=None)
            if best is not None:
                used.add(id(best.event))
            judgement = self._judgement(strike, best, self._horizon(place))
            judged.append(judgement)
            explained.append(self._window(strike, judgement))
        return Verdict(tuple(judged), tuple(e for e in self._events if self._is_unexplained(e, explained)))

    def _detections(self, strike: Strike, used: set[int]) -> list[Detection]:
        ends = strike.ends if strike.ends >= 0 else self._last
        until = max(ends, strike.tick) + (self._bound(strike, None) or 0) + self._settle
        fresh = [e for e in candidates(self._events, strike, until) if id(e) not in used]
        return [self._detection(event, strike) for event in fresh]

    def _detection(self, event: Event, strike: Strike) -> Detection:
        delay, delay_ms = max(0, event.tick - strike.tick), self._delay_ms(event, strike)
        if event.kind == "died":
            bound_ms = None if self._lockstep else RACK_NS * 1e-6
            delay -= self._left_out.between(strike.tick, event.tick)
            return Detection(event, delay, self._death_bound(strike), delay_ms, bound_ms)
        if event.code != "clock_skipped":
            delay -= self._left_out.between(strike.tick, event.tick)
        reader = event.board if event.code in MAILBOX_ALARMS else None
        return Detection(event, delay, self._bound(strike, reader), delay_ms)

    def _death_bound(self, strike: Strike) -> int | None:
        # Lockstep waits for the end of a process that its own clock has killed. Of any other it knows nothing, and
        # goes as fast as it can: neither ticks nor time are a measure.
        if self._lockstep:
            return None if strike.kind == EXTERNAL else self._bound(strike, None)
        return NEIGHBOURS_CYCLES * cycle_ticks(self._layout, strike.board)

    def _delay_ms(self, event: Event, strike: Strike) -> float | None:
        if self._lockstep:
            return None
        # A fault of the arm is counted behind the cycle that has already found it.
        return max(0, event.time_ns - self._offset_ns - strike.time_ns) * 1e-6

    def _horizon(self, place: int) -> int:
        """Return the tick up to which reactions are of this fault: the next one strikes then, or it is long over."""
        strike = self._strikes[place]
        later = [s.tick for s in self._strikes[place + 1 :] if s.tick > strike.tick]
        over = max(strike.ends if strike.ends >= 0 else self._last, strike.tick + (self._bound(strike, None) or 0))
        return min([*later, over + self._settle, self._last + 1])

    def _judgement(self, strike: Strike, best: Detection | None, horizon: int) -> Judgement:
        after = aftermath(strike, self._events, horizon)
        seen: Seen = "not struck" if strike.tick < 0 else "missed" if best is None else "detected"
        return Judgement(
            kind=strike.kind,
            board=strike.board,
            mailbox=strike.mailboxes[0] if _takes_mailbox(strike) and len(strike.mailboxes) == 1 else "",
            joint=strike.joint,
            size=strike.size,
            began=strike.began,
            struck=strike.tick,
            seen=seen,
            is_judged=strike.kind not in SIZED or (strike.size or 0.0) >= judged_size(strike.kind),
            cycle=cycle_ticks(self._layout, strike.board),
            found_by=best.event.board if best and best.event.kind != "died" else "the Rack" if best else "",
            found_as=(best.event.code or best.event.kind) if best else "",
            delay=best.delay if best else None,
            delay_ms=None if best is None or best.delay_ms is None else round(best.delay_ms, 3),
            bound=best.bound if best else self._bound(strike, None),
            bound_ms=best.bound_ms if best else None,
            is_within=best is not None and best.is_within,
            reactions=after.reactions,
            is_recovered=after.is_recovered,
            recovery=after.recovery,
        )

    def _window(self, strike: Strike, judgement: Judgement) -> tuple[Strike, int, int]:
        """Return the ticks in which detections are the fault's, or its consequence."""
        ends = strike.ends if strike.ends >= 0 else self._last
        first = strike.tick if strike.tick >= 0 else strike.began
        last = max(ends, first + (judgement.recovery or 0), first + (judgement.bound or 0))
        return strike, first - 1, last + self._settle

    def _is_unexplained(self, event: Event, windows: Sequence[tuple[Strike, int, int]]) -> bool:
        if event.kind not in ("detection", "died"):
            return False
        around = (strike for strike, first, last in windows if strike.began >= 0 and first <= event.tick <= last)
        return not any(_explains(strike, event) for strike in around)


def _explains(strike: Strike, event: Event) -> bool:
    """Say whether an event in a fault's time can be its consequence."""
    if strike.tick < 0:
        # It was too slight to count as an injection, and may have been found all the same.
        return fits(event, replace(strike, tick=strike.began))
    # A process that ends ends of its own fault, not of another's.
    return event.kind != "died" or strike.board == event.board


def _takes_mailbox(strike: Strike) -> bool:
    return strike.kind != EXTERNAL and KINDS[NUMBERS[strike.kind]].takes_mailbox


def _bound_in(layout: Layout) -> Bound:
    tasks = [task.name for task in layout.tasks]

    def bound(strike: Strike, reader: str | None) -> int | None:
        if strike.kind == EXTERNAL:
            killed = Injection(NUMBERS["kill"], tasks.index(strike.board) if strike.board in tasks else -1)
            return bound_ticks(KINDS[NUMBERS["kill"]], killed, layout, reader)
        assert strike.injection is not None, "a fault of the table has its injection"
        return bound_ticks(KINDS[NUMBERS[strike.kind]], strike.injection, layout, reader)

    return bound
