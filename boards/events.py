"""What happens to a rack, as a record: launch, ends of boards, misses of heartbeats, the end of the run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

EventKind = Literal[
    "launch",
    "ready",
    "start",
    "printed",
    "died",
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


@dataclass(frozen=True)
class Event:
    """One event. `time_ns` is CLOCK_REALTIME, `tick` the system clock's (-1: before the run).

    What faults, detections, reactions and recoveries say to programs: `code`, an alarm's name in lower case, "begins"
    or "ends"; `fault`, its entry in the fault table (-1: none); `subject`, the mailbox, joint or task
    concerned; `value`; `since`, the tick since which it holds. Of a rack that is held and stands still `subject` is
    the level. Of an operator's command `code` is what it says,
    `subject` the level and `value` the serial.
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
