"""Holds: which level of a rack is kept from its work, since when, why, and the command that
releases it."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass

from rack.backplane.layout import MailboxSpec
from rack.backplane.lines import UtilityLines
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.message import Message, State, reason_of
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System
from rack.boards.events import Event
from rack.boards.lan.awaited import awaited
from rack.boards.operator import describe
from rack.levels.messages import Error
from rack.levels.operator import Answer, Operation, answered

STILL_S = 5.0
"""Simulated time without motion after which a held rack reports it as an event."""
PASSED_ON = re.compile(r"(?:holding|waiting for \w+): ")
SAME = 60
"""Characters that identify a reason: the end of a long one is truncated on its way up."""
ASKED = {Error.DISABLED: "enable", Error.DRIVES: "reset"}
"""What an arm that is not enabled waits for, by the error of its status."""
OPERATED = frozenset({"standing", "order", "answer"})
"""Fields in the status of a level that takes an operator's commands."""


@dataclass(frozen=True)
class Hold:
    """One level, or the arm, kept from its own work. The command `release` ends it; empty: it ends
    by itself."""

    level: str
    since_tick: int
    since_s: float
    why: str
    release: str

    @property
    def line(self) -> str:
        """All of it as readable text."""
        return "; ".join(self.parts)

    @property
    def parts(self) -> tuple[str, ...]:
        """The same in one or two parts, for two lines: a command must not be wrapped."""
        how = (f"to release: {self.release}",) if self.release else ()
        return (f"{self.level} {self.why}, since {self.since_s:.2f} s", *how)


def resume_command(rack: str, level: str) -> str:
    """Return the command that ends an operator's command to a level."""
    return f"rack command {rack} {level} resume"


def is_news(reason: str, shown: list[str]) -> bool:
    """Return whether a reason is not yet among those `shown`, and add it: levels repeat reasons of
    the level below."""
    origin = PASSED_ON.split(reason)[-1][:SAME]
    if any(origin in other for other in shown):
        return False
    shown.append(reason)
    return True


class Holds:
    """Finds what holds a running rack."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._lines = UtilityLines(segment)
        tasks = {task.name for task in segment.layout.tasks}
        boxes = [
            box
            for box in segment.layout.mailboxes
            if box.name.endswith(".status") and box.writer in tasks
        ]
        self._statuses = {
            box.writer: open_observer(segment, box.name) for box in boxes if "state" in _fields(box)
        }
        self._operated = {box.writer for box in boxes if _fields(box) >= OPERATED}
        driving = next((box for box in boxes if "demand" in _fields(box)), None)
        self._arm = None if driving is None else driving.writer
        self._stop = (
            ("arm", "braked")
            if driving is None or "braked" in _fields(driving)
            else ("hand", "valves closed")
        )

    def look(self) -> tuple[Hold, ...]:
        """Return the holds now, the arm's first; none once the run is over."""
        if self._segment.run_is_over:
            return ()
        shown: list[str] = []
        held = (hold for level in self._statuses for hold in self._held(level))
        kept = (hold for hold in held if hold.release or is_news(hold.why, shown))
        return (*self._stopped(), *self._awaiting(), *kept)

    def _stopped(self) -> Iterator[Hold]:
        if self._lines.emergency_stop:
            since = (
                self._segment.block(self._arm)[Block.LEVEL_SINCE] if self._arm is not None else 0
            )
            release = f"rack estop {self._segment.layout.rack} --reset"
            what, how = self._stop
            yield self._hold(what, since, f"{how}: emergency stop", release)

    def _awaiting(self) -> Iterator[Hold]:
        for board, why in awaited(self._segment):
            yield self._hold(board, self._segment.block(board)[Block.RELEASED], why, "")

    def _held(self, level: str) -> Iterator[Hold]:
        seen = self._statuses[level].peek()
        if not seen.is_there:
            return
        status = seen.value
        if level in self._operated and status.standing:
            since, serial, what = self._standing(level, status)
            is_hold = status.standing == Operation.HOLD
            is_done = status.answer == Answer.DONE and serial in (status.order, 0)
            done = ", done" if is_done and not is_hold else ""
            why = f"{'held' if is_hold else 'diverted'} by the operator ({what}{done})"
            yield self._hold(level, since, why, resume_command(self._segment.rack, level))
        elif status.state == State.HOLDING:
            since = self._segment.block(level)[Block.LEVEL_SINCE]
            asks = ASKED.get(status.error) if level == self._arm else None
            release = f"rack command {self._segment.rack} {level} {asks}" if asks else ""
            why = f"holding: {reason_of(status) or 'no reason given'}"
            yield self._hold(level, since, why, release)

    def _standing(self, level: str, status: Message) -> tuple[int, int, str]:
        """Return tick, serial and text of the command in force; serial 0 where its message is
        gone."""
        rows = MailboxRing(self._segment, f"{level}.operator").drain().rows
        newest = answered(status)
        mine = {
            int(row["message"]["id"]): row
            for row in rows
            if row["message"]["what"] == status.standing and row["message"]["id"] <= newest
        }
        # A command that was refused has left the one before it in force.
        if status.answer == Answer.REFUSED and len(mine) > 1:
            mine.pop(int(status.order), None)
        if not mine:
            text = Operation(status.standing).name.lower()
            return self._segment.block(level)[Block.LEVEL_SINCE], 0, text
        row = mine.get(int(status.order), mine[max(mine)])
        message = Message(rows["message"].dtype)
        message.raw[:] = row["message"].tobytes()
        return int(row["tick"]), int(message.id), describe(message)

    def _hold(self, level: str, since: int, why: str, release: str) -> Hold:
        return Hold(level, since, since * self._segment.layout.clock_ns * 1e-9, why, release)


class Standstill:
    """Reports, once, a hold under which nothing has moved for a while: the run will not continue by
    itself."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._holds = Holds(segment)
        self._still_since: int | None = None
        self._reported: set[tuple[str, int]] = set()

    def look(self) -> Iterator[Event]:
        """Yield an event for each hold that somebody must end and that has not been reported
        yet."""
        # Here, not above: it needs the kinds of faults, for which `rack status` should not wait.
        from rack.tools.faults.ending import arm_of

        tick = self._segment.words[System.TICK]
        kept = [hold for hold in self._holds.look() if hold.release]
        if not kept or not arm_of(self._segment).is_at_rest:
            self._still_since = None
            return
        self._still_since = tick if self._still_since is None else self._still_since
        for hold in kept:
            still = tick - max(self._still_since, hold.since_tick)
            still_s = still * self._segment.layout.clock_ns * 1e-9
            if still_s >= STILL_S and (hold.level, hold.since_tick) not in self._reported:
                self._reported.add((hold.level, hold.since_tick))
                text = f"nothing has moved for {still_s:.0f} s: {hold.line}"
                code = "standstill"
                since = hold.since_tick
                yield Event(
                    time.time_ns(), tick, "held", "", text, code, subject=hold.level, since=since
                )


def _fields(box: MailboxSpec) -> set[str]:
    return {field.name for field in box.fields}
