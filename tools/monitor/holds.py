"""Holds: which level of a rack is kept from its work, since when, why, and the command that
releases it.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass

from rack.backplane.lines import UtilityLines
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.message import AnyMessage, Message, State, reason_of
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System
from rack.boards.events import Event
from rack.boards.lan.awaited import awaited
from rack.boards.operator import describe
from rack.levels.messages import Error
from rack.levels.operator import Answer, Operation, OperatorCommand, answered
from rack.tools.monitor.newest_messages import Newest

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
    by itself.
    """

    level: str
    since_tick: int
    since_s: float
    why: str
    release: str

    @property
    def line(self) -> str:
        """All of it as readable text."""
        how = f"; to release: {self.release}" if self.release else ""
        return f"{self.level} {self.why}, since {self.since_s:.2f} s{how}"


def resume_command(rack: str, level: str) -> str:
    """Return the command that ends an operator's command to a level."""
    return f"rack command {rack} {level} resume"


def is_news(reason: str, shown: list[str]) -> bool:
    """Return whether a reason is not yet among those `shown`, and add it: levels repeat reasons of
    the level below.
    """
    origin = PASSED_ON.split(reason)[-1][:SAME]
    if any(origin in other for other in shown):
        return False
    shown.append(reason)
    return True


def find_holds(newest: Newest) -> tuple[Hold, ...]:
    """Return what holds a rack now, the hold of its arm first; nothing once its run is over."""
    return () if newest.segment.run_is_over else tuple(_find_holds(newest))


def _find_holds(newest: Newest) -> Iterator[Hold]:
    segment = newest.segment

    def hold(level: str, since: int, why: str, release: str = "") -> Hold:
        return Hold(level, since, since * segment.layout.clock_ns * 1e-9, why, release)

    arm, driving = next(newest.statuses("demand"), ("", None))
    if UtilityLines(segment).emergency_stop:
        is_arm = driving is None or "braked" in _fields(driving)
        what, how = ("arm", "braked") if is_arm else ("hand", "valves closed")
        since = segment.block(arm)[Block.LEVEL_SINCE] if arm else 0
        release = f"rack estop {segment.layout.rack} --reset"
        yield hold(what, since, f"{how}: emergency stop", release)
    for board, why in awaited(segment):
        yield hold(board, segment.block(board)[Block.RELEASED], why)
    tasks = {task.name for task in segment.layout.tasks}
    shown: list[str] = []
    for level, status in newest.statuses("state"):
        if level not in tasks:
            continue
        if _fields(status) >= OPERATED and status.standing:
            since, serial, what = _command_in_force(segment, level, status)
            is_hold = status.standing == Operation.HOLD
            is_done = status.answer == Answer.DONE and serial in (status.order, 0)
            done = ", done" if is_done and not is_hold else ""
            why = f"{'held' if is_hold else 'diverted'} by the operator ({what}{done})"
            yield hold(level, since, why, resume_command(segment.rack, level))
        elif status.state == State.HOLDING:
            asks = ASKED.get(status.error) if level == arm else None
            release = f"rack command {segment.rack} {level} {asks}" if asks else ""
            why = f"holding: {reason_of(status) or 'no reason given'}"
            if release or is_news(why, shown):
                yield hold(level, segment.block(level)[Block.LEVEL_SINCE], why, release)


def _command_in_force(segment: Segment, level: str, status: AnyMessage) -> tuple[int, int, str]:
    """Return tick, serial and text of the operator's command in force at a level; serial 0 where
    its message is gone.
    """
    rows = MailboxRing(segment, f"{level}.operator").drain().rows
    given = rows["message"]
    is_candidate = (given["what"] == status.standing) & (given["id"] <= answered(status))
    # A command that was refused has left the one before it in force.
    if status.answer == Answer.REFUSED and is_candidate.sum() > 1:
        is_candidate &= given["id"] != status.order
    found = rows[is_candidate]
    if not len(found):
        return segment.block(level)[Block.LEVEL_SINCE], 0, Operation(status.standing).name.lower()
    answering = found[found["message"]["id"] == status.order]
    row = (answering if len(answering) else found)[-1]
    message = OperatorCommand(given.dtype)
    message.raw[:] = row["message"].tobytes()
    return int(row["tick"]), message.id, describe(message)


class Standstill:
    """Reports, once, a hold under which nothing has moved for a while: the run will not continue by
    itself.
    """

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._newest = Newest(segment)
        self._still_since: int | None = None
        self._reported: set[tuple[str, int]] = set()

    def look(self) -> Iterator[Event]:
        """Yield an event for each hold that somebody must end and that has not been reported
        yet.
        """
        # Here, not above: it needs the kinds of faults, for which `rack status` should not wait.
        from rack.tools.faults.ending import arm_of

        tick = self._segment.words[System.TICK]
        kept = [hold for hold in find_holds(self._newest) if hold.release]
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


def _fields(message: Message) -> set[str]:
    return {*(message.record.dtype.names or ())}
