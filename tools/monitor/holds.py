"""Finds out which levels of a rack are held, since when, why, and how to release them."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

from rack.backplane.lines import UtilityLines
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.message import AnyMessage, Message, State, get_reason
from rack.backplane.segment import Segment
from rack.backplane.words import Block
from rack.boards.events import Event
from rack.boards.lan.awaited import find_waits
from rack.boards.operator import describe_command
from rack.levels.messages import Error
from rack.levels.operator import Answer, Operation, OperatorCommand, find_answered_serial
from rack.tools.monitor.newest_messages import NewestMessages

STANDSTILL_S = 5.0
"""Simulated time without motion after which a held rack is reported by an event."""
RELAYED_PREFIX = re.compile(r"(?:holding|waiting for \w+): ")
"""Prefix that a level adds to a reason that it relays from the level below."""
COMPARED_CHARACTERS = 60
"""Number of characters that identify a reason. Levels that relay a long reason cut off its end."""
NEEDED_COMMANDS = {Error.DISABLED: "enable", Error.DRIVES: "reset"}
"""Dictionary from the error in an arm's status to the command that the arm needs."""
OPERATOR_FIELDS = frozenset({"standing", "order", "answer"})
"""Fields in the status of a level that takes commands of an operator."""


@dataclass(frozen=True)
class Hold:
    """A level, a board or the arm that cannot proceed, with the reason.

    Attributes:
        since_s: Simulated time at which the hold began.
        release: Command that ends the hold. Empty if it ends by itself.
        task: Task whose state the hold explains. Empty for none.
    """

    level: str
    since_tick: int
    since_s: float
    why: str
    release: str
    task: str = ""

    @property
    def text(self) -> str:
        """Why and since when, as a clause."""
        return f"{self.why}, since {self.since_s:.2f} s"

    @property
    def line(self) -> str:
        """Description of the hold in one line."""
        release_text = f"; to release: {self.release}" if self.release else ""
        return f"{self.level} {self.text}{release_text}"


def format_resume_command(rack: str, level: str) -> str:
    """Return the command line that ends an operator's command to a level."""
    return f"rack command {rack} {level} resume"


def is_new_reason(reason: str, shown: list[str]) -> bool:
    """Return True if a reason has not been shown yet, and add it to `shown`.

    A reason that a level has only relayed from the level below is not new.
    """
    origin = RELAYED_PREFIX.split(reason)[-1][:COMPARED_CHARACTERS]
    if any(origin in other for other in shown):
        return False
    shown.append(reason)
    return True


def find_holds(newest: NewestMessages) -> tuple[Hold, ...]:
    """Find all holds of a rack, beginning with its arm. Empty once its run is over."""
    return () if newest.segment.run_is_over else tuple(_list_holds(newest))


def _list_holds(newest: NewestMessages) -> Iterator[Hold]:
    """Yield holds by an emergency stop, then of boards that await other racks, then of levels."""
    segment = newest.segment

    def hold(level: str, since: int, why: str, release: str = "") -> Hold:
        """Build a hold that began at tick `since`."""
        since_s = since * segment.layout.clock_ns * 1e-9
        return Hold(level, since, since_s, why, release, level)

    arm, driving = next(newest.list_statuses("demand"), ("", None))
    if UtilityLines(segment).emergency_stop:
        is_arm = driving is None or "braked" in _field_names(driving)
        arm_name, state_text = ("arm", "braked") if is_arm else ("hand", "valves closed")
        since = segment.get_block(arm)[Block.LEVEL_SINCE] if arm else 0
        release = f"rack estop {segment.layout.rack} --reset"
        yield replace(hold(arm_name, since, f"{state_text}: emergency stop", release), task=arm)
    for board, why in find_waits(segment):
        yield hold(board, segment.get_block(board)[Block.RELEASED], why)
    tasks = {task.name for task in segment.layout.tasks}
    shown_reasons: list[str] = []
    for level, status in newest.list_statuses("state"):
        if level not in tasks:
            continue
        if _field_names(status) >= OPERATOR_FIELDS and status.standing:
            since, serial, command_text = _find_command_in_force(segment, level, status)
            is_hold = status.standing == Operation.HOLD
            is_done = status.answer == Answer.DONE and serial in (status.order, 0)
            done = ", done" if is_done and not is_hold else ""
            why = f"{'held' if is_hold else 'diverted'} by the operator ({command_text}{done})"
            yield hold(level, since, why, format_resume_command(segment.rack, level))
        elif status.state == State.HOLDING:
            needed = NEEDED_COMMANDS.get(status.error) if level == arm else None
            release = f"rack command {segment.rack} {level} {needed}" if needed else ""
            why = f"holding: {get_reason(status) or 'no reason given'}"
            if release or is_new_reason(why, shown_reasons):
                yield hold(level, segment.get_block(level)[Block.LEVEL_SINCE], why, release)


def _find_command_in_force(
    segment: Segment, level: str, status: AnyMessage
) -> tuple[int, int, str]:
    """Find the operator's command in force at a level.

    Returns:
        Tick, serial and text of the command. The serial is 0 if its message has been overwritten.
    """
    rows = MailboxRing(segment, f"{level}.operator").read_new_rows().rows
    commands = rows["message"]
    is_candidate = (commands["what"] == status.standing) & (
        commands["id"] <= find_answered_serial(status)
    )
    # If the level refused the newest command, the previous one is still in force.
    if status.answer == Answer.REFUSED and is_candidate.sum() > 1:
        is_candidate &= commands["id"] != status.order
    candidates = rows[is_candidate]
    if not len(candidates):
        return (
            segment.get_block(level)[Block.LEVEL_SINCE],
            0,
            Operation(status.standing).name.lower(),
        )
    answering = candidates[candidates["message"]["id"] == status.order]
    row = (answering if len(answering) else candidates)[-1]
    message = OperatorCommand(commands.dtype)
    message.raw[:] = row["message"].tobytes()
    return int(row["tick"]), message.id, describe_command(message)


class StandstillDetector:
    """Reports, once, each hold that only a user can end and during which nothing moves."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._newest = NewestMessages(segment)
        self._still_since: int | None = None
        self._reported: set[tuple[str, int]] = set()

    def list_events(self) -> Iterator[Event]:
        """Yield an event for each unreported hold that has stopped the arm for `STANDSTILL_S`."""
        # Import late: this imports the kinds of faults, which would slow down `rack status`.
        from rack.tools.faults.ending import read_arm

        tick = self._segment.tick
        holds = [hold for hold in find_holds(self._newest) if hold.release]
        if not holds or not read_arm(self._segment).is_at_rest:
            self._still_since = None
            return
        self._still_since = tick if self._still_since is None else self._still_since
        for hold in holds:
            still = tick - max(self._still_since, hold.since_tick)
            still_s = still * self._segment.layout.clock_ns * 1e-9
            if still_s >= STANDSTILL_S and (hold.level, hold.since_tick) not in self._reported:
                self._reported.add((hold.level, hold.since_tick))
                text = f"nothing has moved for {still_s:.0f} s: {hold.line}"
                code = "standstill"
                since = hold.since_tick
                yield Event(
                    time.time_ns(), tick, "held", "", text, code, subject=hold.level, since=since
                )


def _field_names(message: Message) -> set[str]:
    """Return the names of the fields of a message."""
    return {*(message.record.dtype.names or ())}
