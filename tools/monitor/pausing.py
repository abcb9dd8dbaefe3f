"""A rack that is paused, and goes on: in lockstep between two ticks, by single ticks or cycles as
well; in real time by the operator's hold.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.tools.console.answer import Failure
from rack.tools.console.tables import fitted_records
from rack.tools.monitor.desk import LiveDesk
from rack.tools.monitor.snapshot import RackMonitor

LOOK_S = 0.001


@dataclass(frozen=True)
class Stepped:
    """A rack that is held. `levels` has one dict a level: level, state, row, reason."""

    rack: str
    tick: int
    time_s: float
    levels: list[dict[str, str]]

    def lines(self) -> Iterator[str]:
        """Yield the same as readable text."""
        yield f"{self.rack}: held before tick {self.tick}, {self.time_s:.3f} s"
        yield from fitted_records(self.levels)


class Stepper:
    """Steps one rack. Raises `Failure` when it is not in lockstep."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._words = segment.words
        self._executors = {
            task.name: task for task in segment.layout.tasks if task.role == "executor"
        }
        if not self._words[System.LOCKSTEP]:
            hint = f"end it, and start it with: rack run {segment.rack} --lockstep --step"
            raise Failure(f"rack '{segment.rack}' runs in real time, which cannot be held; {hint}")

    def let_go(self) -> None:
        """Let the rack run on."""
        self._words[System.HOLD_AT] = 0

    def hold(self) -> int:
        """Hold the rack, if it is not held yet; return the tick before which it holds."""
        if not self._words[System.HOLD_AT]:
            self._words[System.HOLD_AT] = 1
        return self._await_hold(0)

    def go(self, tick: int) -> None:
        """Let the rack go on, and hold it before `tick`."""
        self._words[System.HOLD_AT] = tick + 1
        self._await_hold(tick)

    def after_cycles(self, at: int, cycles: int, level: str | None) -> int:
        """Return the tick after the release of the last of `cycles` of a level, or of the slowest
        level.

        Raises `Failure` for an unknown level.
        """
        if level is None:
            task = max(self._executors.values(), key=lambda task: task.every)
        elif level in self._executors:
            task = self._executors[level]
        else:
            known = ", ".join(self._executors)
            raise Failure(f"--until {level}: no such level; levels: {known}", 2)
        return task.grid.since(at) + (cycles - 1) * task.every + 1

    def look(self) -> Stepped:
        """Return the rack as it is held."""
        levels = [
            {"level": row.task, "state": row.state, "row": row.row, "reason": row.reason}
            for row in RackMonitor(self._segment).look().tasks
            if row.task in self._executors
        ]
        tick = self._words[System.HELD] - 1
        time_s = tick * self._segment.layout.clock_ns * 1e-9
        return Stepped(self._segment.rack, tick, time_s, levels)

    def _await_hold(self, tick: int) -> int:
        """Wait until the rack holds before `tick` or a later one; return which."""
        while (held := self._words[System.HELD] - 1) < tick:
            if self._segment.run_is_over:
                raise Failure(
                    f"rack '{self._segment.rack}': its run ended at tick {self._words[System.TICK]}"
                )
            time.sleep(LOOK_S)
        return held


class Pause(NamedTuple):
    """A pause: before `tick` in lockstep, otherwise from it on, with the `levels` held for it."""

    tick: int
    levels: list[str]


def pause(segment: Segment) -> Pause:
    """Pause a rack, and return when it is held, or its arm at rest.

    Raises `Failure` where no level is above all others that take a hold, or it is refused.
    """
    if segment.words[System.LOCKSTEP]:
        return Pause(Stepper(segment).hold(), [])
    desk = LiveDesk(segment)
    levels = desk.highest("", "hold")
    if len(levels) != 1:
        found = ", ".join(levels) or "none"
        needed = "of the levels that take a hold one must be above all others"
        raise Failure(f"rack '{segment.rack}' runs in real time: {needed}; highest: {found}")
    reply = desk.give({"level": levels[0], "what": "hold"}, wait=True)
    if reply.fate != "done":
        raise Failure(reply.line)
    return Pause(reply.done, levels)


def resume(segment: Segment) -> list[str]:
    """Let a paused rack go on; return the levels that were held. Raises `Failure` when it is not
    paused.
    """
    words = segment.words
    levels: list[str] = []
    if words[System.LOCKSTEP]:
        is_paused = words[System.HOLD_AT] > 0
        Stepper(segment).let_go()
    else:
        desk = LiveDesk(segment)
        levels = desk.highest("hold")
        is_paused = bool(levels)
        for level in levels:
            reply = desk.give({"level": level, "what": "resume"}, wait=False)
            if not reply.worked:
                raise Failure(reply.line)
    if not is_paused:
        raise Failure(f"rack '{segment.rack}' is not paused")
    return levels
