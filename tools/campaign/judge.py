"""What became of each fault of a trial: struck, found, within its bound, reacted to, recovered from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout
from rack.boards.events import Event
from rack.boards.faults.bounds import MEMORY_NS, RACK_NS, bound_ticks, cycle_ticks, last_read
from rack.boards.faults.consequences import consequence, recovery_ticks
from rack.boards.faults.kinds import KINDS, NUMBERS
from rack.tools.campaign.aftermath import COLLISION, LATCHED, Aftermath, aftermath, takes_cycles
from rack.tools.campaign.detection import MAILBOX_ALARMS, Detection, LeftOut, candidates, explains, fits, table_kind
from rack.tools.campaign.ending import Strike
from rack.tools.campaign.plan import EXTERNAL
from rack.tools.campaign.shape import SIZED, judged_size

Seen = Literal["detected", "missed", "not struck"]
Bound = Callable[[Strike, str | None], int | None]
"""Ticks in which a fault must be found, by a reader or, None, by whoever else."""

SETTLE_S = 0.25
"""Simulated time behind a fault's bounds in which its traces may still be found."""


@dataclass(frozen=True)
class Judgement:
    """What became of one fault. Delays, bounds and recovery are ticks, `cycle` the ticks of the task's cycle.

    `is_judged`: False for a size below the one from which its kind must be seen. `recovery` is the time from the strike
    until everything that was done about it is undone; None: nothing was done, or it was not undone. `recovery_bound` is
    counted from the strike too. `lacking` are reactions that must come and did not. `is_latched`: the kind may end the
    task, and it did.
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
    recovery_bound: int | None = None
    lacking: tuple[str, ...] = ()
    is_latched: bool = False


@dataclass(frozen=True)
class Verdict:
    """The judgements of a trial, and what it found that no fault explains: detections, and misses apart from them."""

    faults: tuple[Judgement, ...]
    unexplained: tuple[Event, ...]
    misses: tuple[Event, ...] = ()


@dataclass(frozen=True)
class Circumstances:
    """The run whose faults are judged.

    `offset_ns` turns CLOCK_MONOTONIC into the events' time. `restart_s`: simulated time that a restart may take.
    `has_failed`: the task ended with an error, as some kinds have it. `moving`: obstacles that move, and may run into
    an arm that a fault has kept where they pass.
    """

    layout: Layout
    offset_ns: int
    is_lockstep: bool = False
    restart_s: float = 2.0
    has_failed: bool = False
    moving: tuple[str, ...] = ()


def judge(strikes: Sequence[Strike], events: Sequence[Event], run: Circumstances) -> Verdict:
    """Judge the faults of a run by what happened in it.

    One event is the detection of one fault: of two that it fits, of the one that struck first and is not found yet. A
    fault of the arm that is over before it must be found, and is not found, has not struck; nor has one that the run
    ends before it must be recovered from.
    """
    return _Judge(strikes, events, run).verdict()


class _Judge:
    def __init__(self, strikes: Sequence[Strike], events: Sequence[Event], run: Circumstances) -> None:
        self._events, self._run, self._layout = events, run, run.layout
        shown = [_shown(strike, events) for strike in strikes]
        self._strikes = sorted(shown, key=lambda s: (s.tick if s.tick >= 0 else s.began, s.fault))
        self._bound = _bound_in(run.layout)
        self._cycles = {task.name: cycle_ticks(run.layout, task.name) for task in run.layout.tasks}
        self._left_out = LeftOut(events)
        self._last = max((event.tick for event in events), default=0)
        self._settle = round(SETTLE_S * 1e9 / run.layout.clock_ns)

    def verdict(self) -> Verdict:
        used: set[int] = set()
        judged = []
        windows = [self._window(strike) for strike in self._strikes]
        for place, strike in enumerate(self._strikes):
            found = self._detections(strike, windows[place][1], used)
            best = min((d for d in found if not self._is_of(d, place)), key=lambda d: d.order, default=None)
            if best is not None:
                used.add(id(best.event))
            elif self._is_brief(strike):
                strike = replace(strike, tick=-1)
            horizon = self._horizon(place, windows[place][1])
            judgement = self._judgement(strike, best, horizon)
            if not judgement.is_recovered and self._last < strike.tick + (judgement.recovery_bound or 0):
                # The run ended too early to tell: to be drawn again.
                judgement = self._judgement(replace(strike, tick=-1), None, horizon)
            judged.append(judgement)
        stray = [event for event in self._events if self._is_stray(event, windows)]
        detections = tuple(event for event in stray if event.kind != "miss")
        return Verdict(tuple(judged), detections, tuple(event for event in stray if event.kind == "miss"))

    def _window(self, strike: Strike) -> tuple[int, int]:
        """Return the first and the last tick in which an event may come of a fault."""
        first = strike.tick if strike.tick >= 0 else strike.began
        if _takes_mailbox(strike) and self._layout.task(strike.board).role == "planner":
            # Its writer may be the one to find what is wrong with a plan, when it makes the next.
            return first - 1, self._last
        over = max(self._ends(strike), first + (self._bound(strike, None) or 0))
        undone = recovery_ticks(table_kind(strike.kind), strike.board, self._layout, self._run.restart_s)
        return first - 1, over + undone + last_read(strike.mailboxes, self._layout) + self._settle

    def _ends(self, strike: Strike) -> int:
        # A task that hangs is killed as soon as it is found, however long it was to hang.
        if consequence(table_kind(strike.kind)).ends_process:
            return strike.tick
        return strike.ends if strike.ends >= 0 else self._last

    def _detections(self, strike: Strike, until: int, used: set[int]) -> list[Detection]:
        fresh = [e for e in candidates(self._events, strike, until) if id(e) not in used]
        return [self._detection(event, strike) for event in fresh]

    def _is_of(self, late: Detection, place: int) -> bool:
        """Say whether a detection, too late for one fault, is in time for one that struck after it."""
        after = (strike for strike in self._strikes[place + 1 :] if fits(late.event, strike))
        return not late.is_within and any(self._detection(late.event, strike).is_within for strike in after)

    def _is_brief(self, strike: Strike) -> bool:
        """Say whether a fault of the arm acted in fewer cycles than it may take to be found."""
        if strike.tick < 0 or KINDS[NUMBERS[table_kind(strike.kind)]].where != "arm":
            return False
        return strike.count * self._cycles[strike.board] < (self._bound(strike, None) or 0)

    def _detection(self, event: Event, strike: Strike) -> Detection:
        delay, delay_ms = max(0, event.tick - strike.tick), self._delay_ms(event, strike)
        if event.code != "clock_skipped":
            delay -= self._left_out.between(strike.tick, event.tick)
        if event.kind == "died":
            # Lockstep waits for the end of a process that its own clock has killed. Of any other it knows nothing, and
            # goes as fast as it can: neither ticks nor time are a measure.
            unbounded = self._run.is_lockstep and strike.kind == EXTERNAL
            bound_ms = None if self._run.is_lockstep else (RACK_NS + MEMORY_NS) * 1e-6
            return Detection(event, delay, None if unbounded else self._bound(strike, None), delay_ms, bound_ms)
        reader = event.board if event.code in MAILBOX_ALARMS else None
        return Detection(event, delay, self._bound(strike, reader), delay_ms)

    def _delay_ms(self, event: Event, strike: Strike) -> float | None:
        if self._run.is_lockstep:
            return None
        # A fault of the arm is counted behind the cycle that has already found it.
        return max(0, event.time_ns - self._run.offset_ns - strike.time_ns) * 1e-6

    def _horizon(self, place: int, last: int) -> int:
        """Return the tick up to which reactions are of this fault: the next one strikes then, or it is long over."""
        later = [s.tick for s in self._strikes[place + 1 :] if s.tick > self._strikes[place].tick]
        return min([*later, last + 1])

    def _judgement(self, strike: Strike, best: Detection | None, horizon: int) -> Judgement:
        after = aftermath(strike, self._events, horizon)
        seen: Seen = "not struck" if strike.tick < 0 else "missed" if best is None else "detected"
        bound = self._recovery_bound(strike, best)
        is_latched = self._is_latched(strike, after)
        is_undone = after.is_undone and (after.recovery or 0) <= bound
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
            is_recovered=is_latched or is_undone,
            recovery=after.recovery,
            recovery_bound=bound,
            lacking=() if strike.tick < 0 else after.lacking,
            is_latched=is_latched,
        )

    def _recovery_bound(self, strike: Strike, best: Detection | None) -> int:
        """Return the ticks from a strike in which everything must be undone."""
        found = best.event.tick if best is not None else strike.tick
        over = max(self._ends(strike), found) - strike.tick
        return over + recovery_ticks(table_kind(strike.kind), strike.board, self._layout, self._run.restart_s)

    def _is_latched(self, strike: Strike, after: Aftermath) -> bool:
        """Say whether the task has ended with an error because of a fault that may end it so."""
        may = consequence(table_kind(strike.kind)).latches and self._run.has_failed
        return may and LATCHED in after.reactions

    def _is_stray(self, event: Event, windows: Sequence[tuple[int, int]]) -> bool:
        """Say whether no fault explains a detection, a death or a miss."""
        if event.kind not in ("detection", "died", "miss") or self._is_met(event):
            return False
        # What a task tells of has the tick of its release, and may come of anything until the end of its cycle.
        until = event.tick + self._cycles.get(event.board, 1) - 1
        windowed = zip(self._strikes, windows, strict=True)
        around = [strike for strike, (first, last) in windowed if first <= until and event.tick <= last]
        return not any(_explains(strike, event) for strike in around if strike.tick >= 0)

    def _is_met(self, event: Event) -> bool:
        """Say whether an obstacle has met an arm that was kept by a fault before, or waits for another way since."""
        is_moving = event.code == COLLISION and any(f"'{name}'" in event.text for name in self._run.moving)
        return is_moving and any(0 <= strike.tick <= event.tick for strike in self._strikes)


def _shown(strike: Strike, events: Sequence[Event]) -> Strike:
    """Return a fault of the arm as having struck, at the latest, when it was found.

    One counts as acting from a certain difference to the truth on; who finds a smaller one is right as well.
    """
    if strike.began < 0 or KINDS[NUMBERS[table_kind(strike.kind)]].where != "arm":
        return strike
    begun = replace(strike, tick=strike.began)
    last = strike.tick if strike.tick >= 0 else strike.ends
    found = min((e.tick for e in events if fits(e, begun) and (last < 0 or e.tick <= last)), default=strike.tick)
    return strike if found == strike.tick else replace(strike, tick=found, count=max(1, strike.count))


def _explains(strike: Strike, event: Event) -> bool:
    # Whoever takes one task's cycles may take those of any task on its core.
    return takes_cycles(strike) if event.kind == "miss" else explains(strike, event)


def _takes_mailbox(strike: Strike) -> bool:
    return KINDS[NUMBERS[table_kind(strike.kind)]].takes_mailbox


def _bound_in(layout: Layout) -> Bound:
    tasks = [task.name for task in layout.tasks]

    def bound(strike: Strike, reader: str | None) -> int | None:
        kind = KINDS[NUMBERS[table_kind(strike.kind)]]
        injection = strike.injection
        if injection is None:
            injection = Injection(NUMBERS[kind.name], tasks.index(strike.board) if strike.board in tasks else -1)
        return bound_ticks(kind, injection, layout, reader)

    return bound
