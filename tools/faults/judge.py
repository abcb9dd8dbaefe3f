"""The judge of faults: did each strike, was it found within its bound, reacted to, and recovered
from?
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from pydantic import TypeAdapter

from rack.backplane.fault_table import NEVER, Injection
from rack.backplane.layout import Layout
from rack.boards.events import Event
from rack.boards.faults.bounds import MEMORY_NS, RACK_NS, cycle_ticks, last_read
from rack.boards.faults.kind import DIED
from rack.tools.faults.ending import EXTERNAL, Strike
from rack.tools.faults.evidence import (
    COLLISION,
    FOUND,
    LATCHED,
    MAILBOX_ALARMS,
    Detection,
    SkippedTicks,
    aftermath,
    explains,
    fits,
)

Seen = Literal["detected", "missed", "not struck"]
Report = dict[str, Any]

SETTLE_S = 0.25
"""Simulated time after a fault's bounds in which its traces may still be found."""


@dataclass(frozen=True)
class Judgement:
    """The judgement of one fault. Delays, bounds and recovery are ticks, `cycle` the ticks of the
    task's cycle.

    `is_judged`: False for a size below the one from which its kind must be found. `recovery` is the
    time from the strike until every reaction is undone and struck messages flow again; None: there
    was nothing to recover from, or it was not seen. `bound` and `recovery_bound` are counted from
    the strike too. `lacking` are required reactions that did not follow. `is_latched`: the kind may
    end the task, and it did.
    """

    kind: str
    board: str
    struck: int
    seen: Seen
    mailbox: str = ""
    joint: str = ""
    size: float | None = None
    began: int = -1
    is_judged: bool = True
    cycle: int = 1
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

    @property
    def part_of_bound(self) -> float | None:
        """The delay as a part of its bound, in time where time is bounded; None without a bound, or
        with bound 0.
        """
        if self.bound_ms is not None and self.delay_ms is not None:
            return self.delay_ms / self.bound_ms
        return self.delay / self.bound if self.bound and self.delay is not None else None


@dataclass(frozen=True)
class FaultVerdict:
    """The judgements of a run's faults, and the detections and misses that no fault explains."""

    faults: tuple[Judgement, ...]
    unexplained: tuple[Event, ...]
    misses: tuple[Event, ...] = ()


@dataclass(frozen=True)
class Circumstances:
    """The run whose faults are judged.

    `offset_ns` turns CLOCK_MONOTONIC into the events' time. `restart_s`: simulated time that a
    restart may take. `has_failed`: the task ended with an error, as some kinds permit. `moving`:
    obstacles that move, and may run into an arm that a fault has stopped in their way.
    """

    layout: Layout
    offset_ns: int
    is_lockstep: bool = False
    restart_s: float = 2.0
    has_failed: bool = False
    moving: tuple[str, ...] = ()


def judge(strikes: Sequence[Strike], events: Sequence[Event], run: Circumstances) -> FaultVerdict:
    """Judge the faults of a run by its events.

    One event is the detection of one fault: of two that it fits, of the one that struck first and
    is not found yet. A fault of the arm that is over before its bound, and is not found, has not
    struck; nor has one whose run ends before the bound of its recovery.
    """
    return Judge(strikes, events, run).verdict()


class Judge:
    """The judge of one run's faults."""

    def __init__(
        self, strikes: Sequence[Strike], events: Sequence[Event], run: Circumstances
    ) -> None:
        self._events = events
        self._run = run
        self._layout = run.layout
        self._strikes = sorted(strikes, key=lambda s: (s.first, s.fault))
        self._tasks = [process.name for process in run.layout.processes]
        self._cycles = {task.name: cycle_ticks(run.layout, task.name) for task in run.layout.tasks}
        self._skipped = SkippedTicks(events)
        self._last = max((event.tick for event in events), default=0)
        self._settle = round(SETTLE_S * 1e9 / run.layout.clock_ns)

    def verdict(self) -> FaultVerdict:
        """Return the judgement of each fault, and what none of them explains."""
        used: set[int] = set()
        judged = []
        windows = [self._window(strike) for strike in self._strikes]
        for place, strike in enumerate(self._strikes):
            last = windows[place][1]
            later = self._strikes[place + 1 :]
            found = self._detections(strike, last, used)
            own = [detection for detection in found if not self._is_of_any(detection, later)]
            # Reactions up to this tick are of this fault: then the next one strikes, or it is
            # long over.
            horizon = min([*(s.tick for s in later if s.tick > strike.tick), last + 1])
            best = min(own, key=lambda detection: detection.order, default=None)
            if best:
                used.add(id(best.event))
            elif self._is_brief(strike):
                strike = replace(strike, tick=-1)
            judgement = self._judgement(strike, best, horizon)
            is_too_early = self._last < strike.tick + (judgement.recovery_bound or 0)
            if not judgement.is_recovered and is_too_early and strike.ends < NEVER:
                # The run ended too early to decide: a campaign draws it again. A fault without an
                # end has no recovery.
                judgement = self._judgement(replace(strike, tick=-1), None, horizon)
            judged.append(judgement)
        stray = [event for event in self._events if self._is_stray(event, windows)]
        return FaultVerdict(
            faults=tuple(judged),
            unexplained=tuple(event for event in stray if event.kind != "miss"),
            misses=tuple(event for event in stray if event.kind == "miss"),
        )

    def _bound(self, strike: Strike, reader: str | None = None) -> int | None:
        """Return the ticks from its strike within which a fault must be found, by a reader or,
        None, by any process.

        One that never shows need not be found.
        """
        task = self._tasks.index(strike.board) if strike.board in self._tasks else -1
        injection = strike.injection or Injection(strike.record.number, task)
        bound = strike.record.bound_ticks(injection, self._layout, reader)
        return bound + strike.hidden if bound is not None and strike.count else None

    def _recovery(self, strike: Strike) -> int:
        return strike.record.recovery_ticks(strike.board, self._layout, self._run.restart_s)

    def _window(self, strike: Strike) -> tuple[int, int]:
        """Return the first and the last tick at which an event may come of a fault."""
        if strike.record.takes_mailbox and self._layout.task(strike.board).role == "planner":
            # The plan's writer itself may find the fault, when it makes the next plan.
            return strike.first - 1, self._last
        return strike.first - 1, self._last_trace(strike, min(end_of(strike), self._last))

    def _last_trace(self, strike: Strike, ends: int) -> int:
        """Return the last tick at which an event may come of a fault that ends at a tick."""
        over = max(ends, strike.first + (self._bound(strike) or 0))
        read = last_read(strike.mailboxes, self._layout)
        return over + self._recovery(strike) + read + self._settle

    def _detections(self, strike: Strike, until: int, used: set[int]) -> list[Detection]:
        if not strike.count:
            # It need not be found: whatever is found after its end is of something else.
            until = min(until, strike.ends)
        fitting = (
            e for e in self._events if e.tick <= until and fits(e, strike) and id(e) not in used
        )
        return [self._detection(event, strike) for event in fitting]

    def _is_periodic(self, mailbox: str) -> bool:
        """Return whether a mailbox has a message in every period: no plan, queue or news has, nor a
        host board's.
        """
        box = self._layout.mailbox(mailbox)
        return (
            self._layout.task(box.writer).role == "executor"
            and box.protocol != "queue"
            and not box.max_age
        )

    def _is_of_any(self, late: Detection, later: Sequence[Strike]) -> bool:
        """Return whether a detection, too late for one fault, is in time for one of those that
        struck after it.
        """
        return not late.is_within and any(
            fits(late.event, strike) and self._detection(late.event, strike).is_within
            for strike in later
        )

    def _is_brief(self, strike: Strike) -> bool:
        """Return whether a fault of the arm never showed, or in fewer cycles than it may take to be
        found.
        """
        if strike.record.where != "arm":
            return False
        until = strike.hidden + strike.count * cycle_ticks(self._layout, strike.board)
        return not strike.count or until < (self._bound(strike) or 0)

    def _detection(self, event: Event, strike: Strike) -> Detection:
        delay = max(0, event.tick - strike.tick)
        if event.code != "clock_skipped":
            delay -= self._skipped.between(strike.tick, event.tick)
        reader = event.board if event.code in MAILBOX_ALARMS else None
        bound = self._bound(strike, reader)
        if self._run.is_lockstep:
            # Lockstep waits for the end of a process that its own clock has killed. It knows
            # nothing of any other, and runs as fast as it can: neither ticks nor time are a
            # measure.
            if event.kind == DIED and strike.kind == EXTERNAL:
                bound = None
            return Detection(event, delay, bound)
        # A fault of the arm is counted after the cycle that has already found it.
        delay_ms = max(0, event.time_ns - self._run.offset_ns - strike.time_ns) * 1e-6
        bound_ms = (RACK_NS + MEMORY_NS) * 1e-6 if event.kind == DIED else None
        return Detection(event, delay, bound, delay_ms, bound_ms)

    def _judgement(self, strike: Strike, best: Detection | None, horizon: int) -> Judgement:
        visible_from = strike.record.visible_from
        owed = tuple(filter(self._is_periodic, strike.affected)) or strike.affected
        after = aftermath(strike, self._events, horizon, owed)
        found = best.event.tick if best else strike.tick
        # Ticks from the strike within which every reaction must be undone.
        ends = max(min(end_of(strike), self._last), found)
        recovery_bound = ends - strike.tick + self._recovery(strike)
        if not all(map(self._is_periodic, owed)):
            # Nothing says when its writer has something to write.
            recovery_bound = self._last + 1 - strike.tick
        # Only a kind that may end the task with an error has this reaction.
        is_latched = self._run.has_failed and LATCHED in after.reactions
        is_undone = after.is_undone and (after.recovery or 0) <= recovery_bound
        return Judgement(
            kind=strike.kind,
            board=strike.board,
            mailbox=strike.affected[0] if len(strike.affected) == 1 else "",
            joint=strike.joint,
            size=strike.size,
            began=strike.began,
            struck=strike.tick,
            is_judged=visible_from is None or (strike.size or 0.0) >= visible_from,
            cycle=cycle_ticks(self._layout, strike.board),
            reactions=after.reactions,
            is_recovered=is_latched or is_undone,
            recovery=after.recovery,
            recovery_bound=recovery_bound,
            lacking=after.lacking,
            is_latched=is_latched,
            **self._seen(strike, best),
        )

    def _seen(self, strike: Strike, best: Detection | None) -> Report:
        """Return what a judgement says of the detection of a fault."""
        if best is None:
            seen = "not struck" if strike.tick < 0 else "missed"
            return {"seen": seen, "bound": self._bound(strike)}
        return {
            "seen": "detected",
            "found_by": "the Rack" if best.event.kind == DIED else best.event.board,
            "found_as": best.event.code or best.event.kind,
            "delay": best.delay,
            "delay_ms": None if best.delay_ms is None else round(best.delay_ms, 3),
            "bound": best.bound,
            "bound_ms": best.bound_ms,
            "is_within": best.is_within,
        }

    def _is_stray(self, event: Event, windows: Sequence[tuple[int, int]]) -> bool:
        """Return whether no fault explains a detection, a death or a miss."""
        if event.kind not in FOUND or self._is_met(event):
            return False
        # An event of a task has the tick of its release, and may come of anything until the end of
        # its cycle.
        until = event.tick + self._cycles.get(event.board, 1) - 1
        return not any(
            strike.tick >= 0 and first <= until and event.tick <= last and explains(strike, event)
            for strike, (first, last) in zip(self._strikes, windows, strict=True)
        )

    def _is_met(self, event: Event) -> bool:
        """Return whether an obstacle has hit an arm that a fault has stopped, or that waits for
        another path since.
        """
        is_moving = event.code == COLLISION and any(
            f"'{name}'" in event.text for name in self._run.moving
        )
        return is_moving and any(0 <= strike.tick <= event.tick for strike in self._strikes)


def end_of(strike: Strike) -> int:
    """Return the tick at which a fault ends, in the run or as planned."""
    # A task that hangs is killed as soon as that is found, however long it was to hang.
    return strike.tick if strike.record.consequence.ends_process else strike.ends


def faults(recorded: Sequence[Mapping[str, Any]], layout: Layout) -> Report:
    """Return every fault injected into a run, detections that none explains, and restarts by task,
    by its events.
    """
    events = [Event(**event) for event in recorded if "tick" in event]
    ended: Mapping[str, Any] = next((event for event in recorded if event["kind"] == "outcome"), {})
    strikes = TypeAdapter(tuple[Strike, ...]).validate_python(ended.get("faults", ()))
    is_lockstep = any(event.kind == "start" and event.text == "lockstep" for event in events)
    verdict = judge(
        strikes, events, Circumstances(layout, ended.get("clock_offset_ns", 0), is_lockstep)
    )
    restarts = Counter(event.board for event in events if event.code == "restart")
    return {
        # Faults that never struck come last.
        "faults": [
            _row(found, layout)
            for found in sorted(verdict.faults, key=lambda f: (f.struck < 0, f.struck))
        ],
        "unexplained": [
            {
                "tick": event.tick,
                "board": event.board,
                "code": event.code or event.kind,
                "text": event.text,
            }
            for event in verdict.unexplained
        ],
        "restarts": dict(restarts),
    }


def _row(found: Judgement, layout: Layout) -> Report:
    tick_ms = layout.clock_ns * 1e-6
    recovery_ms = None if found.recovery is None else round(found.recovery * tick_ms, 6)
    return {
        **asdict(found),
        # Lists, as they are when read back from JSON.
        "reactions": list(found.reactions),
        "lacking": list(found.lacking),
        "delay_cycles": _in_cycles(found.delay, found.cycle),
        "bound_cycles": _in_cycles(found.bound, found.cycle),
        "recovery_ms": recovery_ms,
    }


def _in_cycles(ticks: int | None, cycle: int) -> float | None:
    return None if ticks is None else round(ticks / cycle, 3)
