"""Judgement of faults: whether each acted, was detected in time, and was recovered from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from pydantic import TypeAdapter

from rack.backplane.fault_table import NEVER, Injection
from rack.backplane.layout import Layout
from rack.boards.events import Event
from rack.boards.faults.bounds import MEMORY_NS, RACK_NS, compute_last_read_ticks, cycle_ticks
from rack.boards.faults.kind import DIED
from rack.tools.faults.ending import EXTERNAL, Strike
from rack.tools.faults.evidence import (
    COLLISION,
    DETECTION_KINDS,
    LATCHED,
    MAILBOX_ALARMS,
    SKIPPED,
    Detection,
    can_be_detection,
    can_explain,
    count_skipped_ticks,
    find_aftermath,
)

Seen = Literal["detected", "missed", "not struck"]
Report = dict[str, Any]

SETTLE_S = 0.25
"""Simulated time in s after a fault's bounds in which its effects may still be reported."""


@dataclass(frozen=True)
class Judgement:
    """Judgement of one fault. Delays, bounds and recovery are in ticks.

    Attributes:
        kind: Name of the kind.
        board: Affected task.
        struck: Tick at which the fault first acted. -1 if it did not act.
        seen: Whether the fault was detected.
        mailbox: Affected mailbox. Empty unless there is exactly one.
        joint: Affected joint. Empty unless there is exactly one.
        size: Size of the fault, if its kind has one.
        began: Tick at which the fault began. -1 if it did not begin.
        is_judged: False if the fault is smaller than the size from which it must be detected.
        cycle: Cycle of the affected task in ticks.
        found_by: Board that detected the fault.
        found_as: Code of the detection.
        delay: Ticks from the fault's first action to its detection.
        delay_ms: The delay in ms of wall-clock time.
        bound: Largest permitted delay in ticks. None if there is no bound.
        bound_ms: Largest permitted delay in ms of wall-clock time.
        is_within: Whether the fault was detected within its bound.
        reactions: Codes of the reactions to it.
        is_recovered: Whether the rack recovered from the fault within the bound.
        recovery: Ticks from the fault's first action until every reaction was undone and affected
            mailboxes had new messages. None if this did not happen, or if nothing was affected.
        recovery_bound: Largest permitted value of `recovery`. None if the launch was refused.
        lacking: Required reactions that did not follow.
        is_latched: Whether the fault ended the task, as its kind permits.
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
    def fraction_of_bound(self) -> float | None:
        """Delay divided by its bound. None without a delay or a bound, and for a bound of 0."""
        if self.bound_ms is not None and self.delay_ms is not None:
            return self.delay_ms / self.bound_ms
        return self.delay / self.bound if self.bound and self.delay is not None else None


@dataclass(frozen=True)
class FaultVerdict:
    """Judgements of a run's faults, and the detections and misses that no fault explains."""

    faults: tuple[Judgement, ...]
    unexplained: tuple[Event, ...]
    misses: tuple[Event, ...] = ()


@dataclass(frozen=True)
class Circumstances:
    """Facts about the run whose faults are judged.

    Attributes:
        layout: Layout of the rack.
        offset_ns: Time of the events minus CLOCK_MONOTONIC, in ns.
        is_lockstep: Whether the run was in lockstep.
        restart_s: Simulated time in s that a restart may take.
        has_failed: Whether the task ended with an error, as some kinds permit.
        moving: Obstacles that move, and may collide with an arm that a fault has stopped.
    """

    layout: Layout
    offset_ns: int
    is_lockstep: bool = False
    restart_s: float = 2.0
    has_failed: bool = False
    moving: tuple[str, ...] = ()


class Judge:
    """Evaluates the faults of one run from its events.

    Each event counts as the detection of at most one fault. If it fits several, it counts for the
    first to act that has no detection yet. A fault counts as not having acted in two cases: it is a
    fault of the arm that ended undetected before it had to be detected, or the run ended without a
    recovery before the bound of the recovery.

    Args:
        strikes: Faults of the run.
        events: Events of the run.
        run: Facts about the run.
    """

    def __init__(
        self, strikes: Sequence[Strike], events: Sequence[Event], run: Circumstances
    ) -> None:
        self._events = events
        self._run = run
        self._layout = run.layout
        self._strikes = sorted(strikes, key=lambda strike: (strike.first_tick, strike.fault))
        self._tasks = [process.name for process in run.layout.processes]
        self._cycles = {task.name: cycle_ticks(run.layout, task.name) for task in run.layout.tasks}
        self._last = max((event.tick for event in events), default=0)
        self._settle = run.layout.to_ticks(SETTLE_S)

    def judge_all(self) -> FaultVerdict:
        """Return the judgement of each fault, and the events that no fault explains."""
        used: set[int] = set()
        judged = []
        windows = [self._compute_window(strike) for strike in self._strikes]
        for index, strike in enumerate(self._strikes):
            last = windows[index][1]
            later = self._strikes[index + 1 :]
            own_detections = [
                detection
                for detection in self._list_detections(strike, last, used)
                if not self._is_in_time_for_later(detection, later)
            ]
            # Reactions belong to this fault until the next fault acts, or until the end of this
            # fault's window.
            horizon = min([*(s.tick for s in later if s.tick > strike.tick), last + 1])
            best = min(own_detections, key=lambda detection: detection.sort_key, default=None)
            if best:
                used.add(id(best.event))
            elif self._is_brief(strike):
                strike = replace(strike, tick=-1)
            judgement = self._build_judgement(strike, best, horizon)
            is_too_early = self._last < strike.tick + (judgement.recovery_bound or 0)
            if not judgement.is_recovered and is_too_early and strike.ends < NEVER:
                # The run ended too early to decide, so a campaign will draw the fault again. A
                # fault without an end has no recovery.
                judgement = self._build_judgement(replace(strike, tick=-1), None, horizon)
            judged.append(judgement)
        stray = [event for event in self._events if self._is_stray(event, windows)]
        return FaultVerdict(
            faults=tuple(judged),
            unexplained=tuple(event for event in stray if event.kind != "miss"),
            misses=tuple(event for event in stray if event.kind == "miss"),
        )

    def _compute_bound(self, strike: Strike, reader: str | None = None) -> int | None:
        """Return the ticks from the first action of a fault within which it must be detected.

        None if there is no bound, or if the fault never had a detectable effect. Without a
        `reader`, the bound applies to whichever process detects the fault first.
        """
        task = self._tasks.index(strike.board) if strike.board in self._tasks else -1
        injection = strike.injection or Injection(strike.record.number, task)
        bound = strike.record.compute_bound_ticks(injection, self._layout, reader)
        return bound + strike.hidden if bound is not None and strike.count else None

    def _compute_recovery(self, strike: Strike) -> int:
        """Return the time in ticks within which the rack must have recovered from a fault."""
        record = strike.record
        ticks = record.compute_recovery_ticks(strike.board, self._layout, self._run.restart_s)
        if strike.injection is not None:
            ticks += record.compute_tail_ticks(strike.injection, self._layout)
        return ticks

    def _compute_window(self, strike: Strike) -> tuple[int, int]:
        """Return the first and the last tick at which an event may be caused by a fault."""
        if strike.record.takes_mailbox and self._layout.find_task(strike.board).role == "planner":
            # The planner itself may detect the fault, but only when it makes its next plan.
            return strike.first_tick - 1, self._last
        return strike.first_tick - 1, self._find_last_effect(
            strike, min(find_end(strike), self._last)
        )

    def _find_last_effect(self, strike: Strike, ends: int) -> int:
        """Return the last tick at which a fault that ends at tick `ends` may cause an event."""
        over = max(ends, strike.first_tick + (self._compute_bound(strike) or 0))
        # Faults of the arm affect no messages, which a slow task might read much later.
        mailboxes = () if strike.record.where == "arm" else strike.mailboxes
        read = compute_last_read_ticks(mailboxes, self._layout)
        return over + self._compute_recovery(strike) + read + self._settle

    def _list_detections(self, strike: Strike, last_tick: int, used: set[int]) -> list[Detection]:
        """Return the possible detections of a fault up to `last_tick`, without events in `used`."""
        if not strike.count:
            # The fault need not be detected, so an event after its end has another cause.
            last_tick = min(last_tick, strike.ends)
        fitting = (
            event
            for event in self._events
            if event.tick <= last_tick and can_be_detection(event, strike) and id(event) not in used
        )
        return [self._build_detection(event, strike) for event in fitting]

    def _is_periodic(self, mailbox: str) -> bool:
        """Return True if a mailbox gets a message in every period of its writer.

        Mailboxes of planners and host boards, queues, and mailboxes with a maximum age do not.
        """
        mailbox_spec = self._layout.find_mailbox(mailbox)
        return (
            self._layout.find_task(mailbox_spec.writer).role == "executor"
            and mailbox_spec.protocol != "queue"
            and not mailbox_spec.max_age
        )

    def _is_in_time_for_later(self, detection: Detection, later: Sequence[Strike]) -> bool:
        """Return True if a detection that is too late for one fault is in time for a later one."""
        return not detection.is_within and any(
            can_be_detection(detection.event, strike)
            and self._build_detection(detection.event, strike).is_within
            for strike in later
        )

    def _is_brief(self, strike: Strike) -> bool:
        """Return True if a fault of the arm ended before it had to be detected."""
        if strike.record.where != "arm":
            return False
        active_ticks = strike.hidden + strike.count * cycle_ticks(self._layout, strike.board)
        return not strike.count or active_ticks < (self._compute_bound(strike) or 0)

    def _build_detection(self, event: Event, strike: Strike) -> Detection:
        """Build the detection of a fault from an event. Compute its delay and its bound."""
        delay = max(0, event.tick - strike.tick)
        if event.code != SKIPPED:
            delay -= count_skipped_ticks(self._events, strike.tick, event.tick)
        reader = event.board if event.code in MAILBOX_ALARMS else None
        bound = self._compute_bound(strike, reader)
        if self._run.is_lockstep:
            # In lockstep the clock waits for the end of each process that it kills. It does not
            # know of an external kill, and runs on as fast as it can. Neither ticks nor time
            # measure the delay in this case.
            if event.kind == DIED and strike.kind == EXTERNAL:
                bound = None
            return Detection(event, delay, bound)
        # The difference may be negative, because a fault of the arm is recorded after the cycle
        # that found it.
        delay_ms = max(0, event.time_ns - self._run.offset_ns - strike.time_ns) * 1e-6
        bound_ms = (RACK_NS + MEMORY_NS) * 1e-6 if event.kind == DIED else None
        return Detection(event, delay, bound, delay_ms, bound_ms)

    def _build_judgement(self, strike: Strike, best: Detection | None, horizon: int) -> Judgement:
        """Build the judgement of a fault from its best detection and the reactions to it.

        Reactions from tick `horizon` on do not belong to the fault.
        """
        visible_from = strike.record.visible_from
        owed = (
            tuple(filter(self._is_periodic, strike.affected_mailboxes)) or strike.affected_mailboxes
        )
        aftermath_found = find_aftermath(strike, self._events, horizon, owed)
        found_tick = best.event.tick if best else strike.tick
        # Ticks from the first action within which every reaction must be undone.
        ends = max(min(find_end(strike), self._last), found_tick)
        recovery_bound = ends - strike.tick + self._compute_recovery(strike)
        if not all(map(self._is_periodic, owed)):
            # The writer has no period, so its next message may come at any time in the run.
            recovery_bound = self._last + 1 - strike.tick
        # Only kinds that may end the task with an error have this reaction.
        is_latched = self._run.has_failed and LATCHED in aftermath_found.reactions
        is_undone = aftermath_found.is_undone and (aftermath_found.recovery or 0) <= recovery_bound
        return Judgement(
            kind=strike.kind,
            board=strike.board,
            mailbox=strike.affected_mailboxes[0] if len(strike.affected_mailboxes) == 1 else "",
            joint=strike.joint,
            size=strike.size,
            began=strike.began,
            struck=strike.tick,
            is_judged=visible_from is None or (strike.size or 0.0) >= visible_from,
            cycle=cycle_ticks(self._layout, strike.board),
            reactions=aftermath_found.reactions,
            is_recovered=is_latched or is_undone,
            recovery=aftermath_found.recovery,
            recovery_bound=recovery_bound,
            lacking=aftermath_found.lacking,
            is_latched=is_latched,
            **self._describe_detection(strike, best),
        )

    def _describe_detection(self, strike: Strike, best: Detection | None) -> Report:
        """Return the fields of a judgement that describe the detection."""
        if best is None:
            seen_text = "not struck" if strike.tick < 0 else "missed"
            return {"seen": seen_text, "bound": self._compute_bound(strike)}
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
        """Return True if an event is a detection, a death or a miss that no fault explains."""
        if event.kind not in DETECTION_KINDS or self._is_obstacle_collision(event):
            return False
        # An event of a task has the tick of its release, but its cause may act until the end of
        # the cycle.
        last_tick = event.tick + self._cycles.get(event.board, 1) - 1
        return not any(
            strike.tick >= 0
            and first <= last_tick
            and event.tick <= last
            and can_explain(strike, event)
            for strike, (first, last) in zip(self._strikes, windows, strict=True)
        )

    def _is_obstacle_collision(self, event: Event) -> bool:
        """Return True if a moving obstacle hit an arm that an earlier fault may have stopped."""
        is_moving = event.code == COLLISION and any(
            f"'{name}'" in event.text for name in self._run.moving
        )
        return is_moving and any(0 <= strike.tick <= event.tick for strike in self._strikes)


def find_end(strike: Strike) -> int:
    """Return the planned end of a fault, or its first action if it ends the task's process."""
    # A hanging task is killed as soon as the hang is detected, before the fault's planned end.
    return strike.tick if strike.record.consequence.ends_process else strike.ends


def report_faults(recorded: Sequence[Mapping[str, Any]], layout: Layout) -> Report:
    """Evaluate the faults in the recorded events of a run and return the results for its report."""
    own_events = [Event(**event) for event in recorded if "tick" in event]
    outcome: Mapping[str, Any] = next(
        (event for event in recorded if event["kind"] == "outcome"), {}
    )
    # Faults that acted before a run continues another one may have been detected there.
    events = [*(Event(**event) for event in outcome.get("earlier", ())), *own_events]
    strikes = TypeAdapter(tuple[Strike, ...]).validate_python(outcome.get("faults", ()))
    is_lockstep = any(event.kind == "start" and event.text == "lockstep" for event in own_events)
    run = Circumstances(layout, outcome.get("clock_offset_ns", 0), is_lockstep)
    verdict = Judge(strikes, events, run).judge_all()
    restarts = Counter(event.board for event in own_events if event.code == "restart")
    return {
        # Faults that never acted come last.
        "faults": [
            _build_row(judgement, layout)
            for judgement in sorted(
                verdict.faults, key=lambda fault: (fault.struck < 0, fault.struck)
            )
        ],
        "unexplained": [
            {
                "tick": event.tick,
                "board": event.board,
                "code": event.code or event.kind,
                "text": event.text,
            }
            for event in verdict.unexplained
            if event in own_events
        ],
        "restarts": dict(restarts),
    }


def _build_row(judgement: Judgement, layout: Layout) -> Report:
    """Convert a judgement to a row of the report."""
    tick_ms = layout.clock_ns * 1e-6
    recovery_ms = None if judgement.recovery is None else round(judgement.recovery * tick_ms, 6)
    return {
        **asdict(judgement),
        # Convert tuples to lists, so that the row equals itself when read back from JSON.
        "reactions": list(judgement.reactions),
        "lacking": list(judgement.lacking),
        "delay_cycles": _to_cycles(judgement.delay, judgement.cycle),
        "bound_cycles": _to_cycles(judgement.bound, judgement.cycle),
        "recovery_ms": recovery_ms,
    }


def _to_cycles(ticks: int | None, cycle: int) -> float | None:
    """Convert ticks to cycles of the affected task. None remains None."""
    return None if ticks is None else round(ticks / cycle, 3)
