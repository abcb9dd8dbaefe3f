"""Events of a run as they happen, and the assessment of how the run ended."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.message import AnyMessage, State, format_state, get_reason
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, System

if TYPE_CHECKING:
    from rack.levels.tables import GoalConfig

EventKind = Literal[
    "launch",
    "waiting",
    "ready",
    "start",
    "printed",
    "died",
    "done",
    "stop",
    "end",
    "recorder",
    "command",
    "fault",
    "detection",
    "miss",
    "reaction",
    "recovery",
    "held",
]
CONTINUATION_CODE = "continues"
"""Code of the launch event of a run that continues another one. Its tick is the run's first."""
OF_LAUNCH = ("launch", "ready", "start")
"""Kinds of events that each launch reports. A continuation does not take them over."""


@dataclass(frozen=True)
class Event:
    """Occurrence in a run.

    Attributes:
        time_ns: CLOCK_REALTIME.
        tick: Tick of the system clock, -1 before the run.
        kind: Kind of event.
        board: Board that the event concerns, empty for the whole rack.
        text: Description, to be read by a person.
        code: Code, to be read by programs: an alarm's name in lower case, "begins" or "ends" for
            a fault, or an operator's command.
        fault: Index of the fault's entry in the fault table, -1 for none.
        subject: Affected mailbox, joint, task or level.
        value: Measured value, or the serial of a command.
        since: Tick at which the condition began, -1 if unknown.
    """

    time_ns: int
    tick: int
    kind: EventKind
    board: str
    text: str
    code: str = ""
    fault: int = -1
    subject: str = ""
    value: float = 0.0
    since: int = -1


DEMANDED = "a stop is demanded"
NO_TORQUE = "no torque"
"""`Braking.why` if the brakes engaged because no torque was received in time.

If the safety functions required the braking, it is `DEMANDED`, and other events show the cause.
"""
MAX_HOLD_MS = 5e3
"""Longest time, in ms, for which an arm may be braked or a level may hold without interruption.

A longer time without a known cause makes a run fail.
"""
MAX_BRAKED_FRACTION = 0.5
"""Share of a run for which an arm may be braked in total without a known cause."""


@dataclass(frozen=True)
class Braking:
    """Period for which an arm's brakes were engaged.

    Attributes:
        why: Reason why the brakes engaged.
        since: Tick at which the brakes engaged.
        lasted_ms: Time for which they were engaged.
    """

    why: str
    since: int
    lasted_ms: float


def list_brakings(events: Sequence[Event], end: int, tick_ms: float) -> tuple[Braking, ...]:
    """Return the periods for which brakes were engaged in a run, except the one at the start.

    Args:
        events: Events of the run.
        end: Number of ticks of the run. Brakes that were not released count as engaged until then.
        tick_ms: Length of a tick in ms.
    """
    changes = [event for event in events if event.code in ("brakes_closed", "brakes_opened")]
    engagements = [
        (change.subject, change.tick - int(change.value), change.tick)
        for change in changes
        if change.code == "brakes_opened"
    ]
    last_of_each_arm = {change.board: change for change in changes}.values()
    engagements += [
        (change.subject, change.tick, end)
        for change in last_of_each_arm
        if change.code == "brakes_closed"
    ]
    return tuple(
        Braking(why, since, round((until - since) * tick_ms, 6))
        for why, since, until in engagements
        if why
    )


def format_brakings(brakings: Sequence[Braking]) -> str:
    """Describe in one line how often, how long and why brakes were engaged.

    Args:
        brakings: Periods for which brakes were engaged, at least one.
    """
    longest = max(brakings, key=lambda braking: braking.lasted_ms)
    times = (
        f"{sum(braking.lasted_ms for braking in brakings):g} ms in all, longest"
        f" {longest.lasted_ms:g} ms at tick {longest.since}"
    )
    reasons = ", ".join(
        f"{why} ({count})"
        for why, count in Counter(braking.why for braking in brakings).most_common()
    )
    return f"brakes engaged {len(brakings)} time{'s' * (len(brakings) > 1)}, {times}: {reasons}"


Cause = Literal[
    "task done",
    "task refused",
    "task failed",
    "time over",
    "stopped",
    "board lost",
    "launcher lost",
]
"""Reason why a run ended.

"task refused" means that the task ended with an error before its first move, "task failed" that it
ended with an error later.
"""
SUCCESSES: tuple[Cause, ...] = ("task done", "time over")
"""Causes with which a run has succeeded if there are no faults."""


@dataclass(frozen=True)
class Outcome:
    """Result of a run.

    Attributes:
        cause: Reason for the end.
        ticks: Length in ticks.
        state: Last state of the level that ends the run.
        reason: Reason in the last status of that level.
        digest: Digest of the run.
        faults: Reasons why the run failed: latched faults, lost boards, objects too far from their
            goals although the task reports that it is done, long holds without a known cause,
            and levels that lost too many cycles.
        brakings: Periods for which brakes were engaged, except the one at the start.
        objects: Final positions of objects with goals.
        excused: A line for each level that lost too many cycles because of injected faults, which
            is not a failure.
    """

    cause: Cause
    ticks: int
    state: str
    reason: str
    digest: str
    faults: tuple[str, ...]
    brakings: tuple[Braking, ...] = ()
    objects: tuple[ObjectEnd, ...] = ()
    excused: tuple[str, ...] = ()

    @property
    def failure(self) -> str:
        """Reason why the run failed, empty if it succeeded.

        A run fails if there are faults, or if its cause is not one of `SUCCESSES`.
        """
        faults = "; ".join(self.faults)
        if self.cause in SUCCESSES:
            return faults
        return f"{self.cause}: {faults or self.reason or f'after {self.ticks} ticks'}"

    @property
    def is_success(self) -> bool:
        """True if the run succeeded."""
        return not self.failure


def get_event_order(entry: Mapping[str, Any]) -> float:
    """Return the tick of an entry in an event log, as a sort key.

    Entries without a tick, such as the outcome, get infinity, which sorts them last. Logs must be
    sorted because some events are reported late. For example, if the board that drives an arm is
    lost, it reports the engagement of the brakes only after it has rejoined.
    """
    return float(entry.get("tick", math.inf))


class Journal:
    """Stores the events of a run, and passes each new event to a callback.

    Attributes:
        events: The recorded events, oldest first.
        segment: Memory of the rack, from which events get their ticks. While it is None, events
            get tick -1.
    """

    def __init__(self, on_event: Callable[[Event], None] | None) -> None:
        self.events: list[Event] = []
        self.segment: Segment | None = None
        self._on_event = on_event

    def add_event(
        self,
        kind: EventKind,
        board: str,
        text: str,
        code: str = "",
        at_ns: int | None = None,
        tick: int | None = None,
        subject: str = "",
    ) -> None:
        """Create an event and record it.

        Args:
            kind: Kind of event.
            board: Board that the event concerns, empty for the whole rack.
            text: Description, to be read by a person.
            code: Code, to be read by programs.
            at_ns: Time of the event on CLOCK_MONOTONIC, by default now.
            tick: Tick of the event, by default the current tick.
            subject: Affected mailbox, joint, task or level.
        """
        now_ns = time.time_ns()
        stamp_ns = now_ns if at_ns is None else now_ns - time.monotonic_ns() + at_ns
        if tick is None:
            tick = -1
            if self.segment is not None and self.segment.words[System.STATE] != Run.STARTING:
                tick = self.segment.tick
        self.record_event(Event(stamp_ns, tick, kind, board, text, code, subject=subject))

    def record_event(self, event: Event) -> None:
        """Append an event to the list, and pass it to `on_event`."""
        self.events.append(event)
        if self._on_event:
            self._on_event(event)


def iterate_statuses(segment: Segment, field: str) -> Iterator[tuple[str, AnyMessage]]:
    """Yield (board, last status) for each level whose status has a field named `field`.

    Levels that have not written a status are left out.
    """
    for box in segment.layout.mailboxes:
        if box.name.endswith(".status") and field in (declared.name for declared in box.fields):
            status = open_observer(segment, box.name).peek()
            if status.has_message:
                yield box.writer, status.message


def iterate_arm_states(segment: Segment) -> Iterator[tuple[str, AnyMessage]]:
    """Yield (board, last state) for each arm and each hand."""
    for box in segment.layout.mailboxes:
        if box.message == "arm_state":
            yield box.writer, open_observer(segment, box.name).peek().message


class Ending:
    """Determines how a run has ended, from the last messages of its levels.

    Args:
        segment: Memory of the rack.
        ends_run: Status mailbox of the level that ends the run, as in `ClockWiring`.
        silent: Number of ticks without a status after which the run ends, as in `ClockWiring`.
        longest: Number of ticks after which the run ends, as in `ClockWiring`.
    """

    def __init__(self, segment: Segment, ends_run: str | None, silent: int, longest: int) -> None:
        self._segment = segment
        self._ends_run = ends_run
        self._longest = longest
        self._status: AnyMessage | None = None
        self._counts_moves = self._is_too_long = False
        self._silent_ticks = 0
        if ends_run is not None:
            observer = open_observer(segment, ends_run)
            reading = observer.peek()
            self._status = reading.message
            # The field `moves` of a status counts the moves of the task.
            self._counts_moves = any(
                field.name == "moves" and not field.shape for field in observer.spec.fields
            )
            if reading.message.state not in (State.DONE, State.ERROR):
                ticks = segment.words[System.TICK]
                silent_ticks = ticks - (observer.newest if reading.has_message else 0)
                self._silent_ticks = silent_ticks if silent_ticks > silent else 0
                self._is_too_long = 0 < longest <= ticks

    def find_final_state(self) -> tuple[str, str]:
        """Return the last state of the level that ends the run, and the reason for this state.

        Both are empty if no level ends the run. If the level has not written a status for too long,
        the reason states for how long.
        """
        status = self._status
        if status is None:
            return "", ""
        tick_s = self._segment.layout.clock_ns * 1e-9
        reason = get_reason(status)
        if self._silent_ticks:
            reason = (
                f"'{self._ends_run}' has not been written for {self._silent_ticks * tick_s:g} s"
            )
        elif self._is_too_long:
            reason = (
                f"'{self._ends_run}' has been neither done nor error for {self._longest * tick_s:g}"
                f" s, the limit supervision.lockstep_end_s{reason and f': {reason}'}"
            )
        return format_state(status.state), reason

    def list_latched_faults(self) -> list[str]:
        """Return one line for each level or arm with a latched fault.

        A level has a latched fault if its last status reports an error. The level that ends the run
        is not listed. An arm has a latched fault if it has exceeded limits or had unintended
        contacts. It is not listed if the level that drives it is.
        """
        faults = {
            board: f"arm of '{board}': limits exceeded in {state.violations} substeps,"
            f" {state.touches} unintended contacts"
            for board, state in iterate_arm_states(self._segment)
            if state.violations or state.touches
        }
        for board, status in iterate_statuses(self._segment, "error"):
            if status.error and f"{board}.status" != self._ends_run:
                why = get_reason(status) or f"error {status.error}"
                faults[board] = f"level '{board}': {why}"
        return [*faults.values()]

    def find_long_holds(
        self, events: Sequence[Event], brakings: Sequence[Braking], ran_ms: float
    ) -> Iterator[str]:
        """Yield a line for each hold that was too long.

        If arms were braked for longer than `MAX_HOLD_MS` without interruption, or for more than
        `MAX_BRAKED_FRACTION` of the run in total, yield one line about all of them. Otherwise yield
        a line for each level that is in a hold of more than `MAX_HOLD_MS` when the run ends.

        Nothing is yielded if the cause is known: a fault was injected, an operator has issued a
        command, or the safety functions require a stop. Levels of a rack on a network are not
        listed, because they may be waiting for other racks.

        Args:
            events: Events of the run.
            brakings: Periods for which brakes were engaged.
            ran_ms: Length of the run in ms.
        """
        segment = self._segment
        if segment.words[System.DEMAND] or any(
            event.kind in ("fault", "command") for event in events
        ):
            return
        tick_ms = segment.layout.clock_ns * 1e-6
        hands = dict(iterate_statuses(segment, "tension"))
        arms = dict((*iterate_arm_states(segment), *iterate_statuses(segment, "braked")))
        counted = [braking for braking in brakings if braking.why != DEMANDED]
        for name, message in () if brakings else arms.items():
            # The brakes have been engaged since the start.
            if message.braked and name not in hands:
                since = segment.get_block(name)[Block.LEVEL_SINCE]
                why = get_reason(message) or NO_TORQUE
                counted.append(Braking(why, since, ran_ms - since * tick_ms))
        times = [braking.lasted_ms for braking in counted]
        if max(times, default=0.0) > MAX_HOLD_MS or sum(times) > MAX_BRAKED_FRACTION * ran_ms:
            yield f"held without a known cause, in {ran_ms:g} ms: {format_brakings(counted)}"
            return
        if any(box.name.startswith("lan.") for box in segment.layout.mailboxes):
            return
        for name, status in iterate_statuses(segment, "state"):
            block = segment.get_block(name)
            lasted_ms = ran_ms - block[Block.LEVEL_SINCE] * tick_ms
            if block[Block.LEVEL_STATE] == State.HOLDING and lasted_ms > MAX_HOLD_MS:
                yield (
                    f"level '{name}' held for {lasted_ms:g} ms without a known cause:"
                    f" {get_reason(status) or 'no reason given'}"
                )

    def find_object_ends(self, goals: Mapping[int, GoalConfig]) -> tuple[ObjectEnd, ...]:
        """Compare the last sensed position of each object that has a goal with its goal.

        The result is empty if no level senses objects.

        Args:
            goals: A dictionary from the row of an object in the scene message to its goal.
        """
        for box in self._segment.layout.mailboxes:
            if (
                box.message == "scene"
                and (scene := open_observer(self._segment, box.name).peek()).has_message
            ):
                return tuple(
                    ObjectEnd(
                        goal.object,
                        goal.position,
                        (ended := scene.message.position[row].tolist()),
                        round(1e3 * math.dist(ended, goal.position), 3),
                        goal.tolerance_mm,
                    )
                    for row, goal in goals.items()
                )
        return ()

    def find_cause(self) -> Cause:
        """Return why a run ended. Call this only if the run was not stopped by a request."""
        status = self._status
        if status is None:
            return "time over"
        if status.state != State.ERROR and not (self._silent_ticks or self._is_too_long):
            return "task done" if status.state == State.DONE else "time over"
        # A refused task has made no moves.
        return "task refused" if self._counts_moves and not status.moves else "task failed"


@dataclass(frozen=True)
class ObjectEnd:
    """Goal and final position of an object.

    Attributes:
        object: Name of the object.
        goal: Position of the goal in m.
        ended: Final position in m.
        off_mm: Distance between the two.
        tolerance_mm: Permitted distance.
    """

    object: str
    goal: Sequence[float]
    ended: Sequence[float]
    off_mm: float
    tolerance_mm: float

    def __str__(self) -> str:
        return (
            f"object '{self.object}' ended {self.off_mm:.0f} mm from its goal (tolerance"
            f" {self.tolerance_mm:g} mm)"
        )
