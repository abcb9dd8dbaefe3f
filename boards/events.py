"""What happens to a rack, as a record: launch, ends of boards, misses of heartbeats, the end of the run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

EventKind = Literal["launch", "ready", "start", "printed", "died", "hang", "stop", "end", "recorder"]


@dataclass(frozen=True)
class Event:
    """One event. `time_ns` is CLOCK_REALTIME, `tick` the system clock's (-1: before the run)."""

    time_ns: int
    tick: int
    kind: EventKind
    board: str
    text: str
