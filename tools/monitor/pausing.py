"""Pauses a rack, and lets it continue.

In lockstep the rack is held between two ticks, and can be stepped by ticks or cycles. In real time
an operator's hold stops its arm.
"""

from __future__ import annotations

import time
from typing import NamedTuple

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.tools.console.answer import Document, Failure
from rack.tools.monitor.desk import LevelCommander
from rack.tools.monitor.snapshot import RackMonitor

CHECK_INTERVAL_S = 0.001
"""Time between two checks of whether the rack is held."""


class Stepper:
    """Steps one rack in lockstep.

    The constructor raises `Failure` for a rack that does not run in lockstep.
    """

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._words = segment.words
        self._executors = {
            task.name: task for task in segment.layout.tasks if task.role == "executor"
        }
        if not self._words[System.LOCKSTEP]:
            hint = f"end it, and start it with: rack run {segment.rack} --lockstep --step"
            raise Failure(f"rack '{segment.rack}' runs in real time, which cannot be held; {hint}")

    def hold_rack(self) -> int:
        """Hold the rack if it is not held yet. Returns the tick before which it is held."""
        if not self._words[System.HOLD_AT]:
            self._words[System.HOLD_AT] = 1
        return self._await_hold_at(0)

    def run_to(self, tick: int) -> None:
        """Let the rack continue, and hold it before `tick`."""
        self._words[System.HOLD_AT] = tick + 1
        self._await_hold_at(tick)

    def find_end_tick(self, at: int, cycles: int, level: str | None) -> int:
        """Return the tick that follows the release of the last of `cycles` cycles.

        Args:
            at: The current tick.
            cycles: Number of cycles.
            level: The level whose cycles count. None for the slowest one.

        Raises:
            Failure: The level is unknown.
        """
        if level is None:
            task = max(self._executors.values(), key=lambda task: task.every)
        elif level in self._executors:
            task = self._executors[level]
        else:
            known = ", ".join(self._executors)
            raise Failure(f"--until {level}: no such level; valid levels: {known}", 2)
        return task.grid.find_tick(at) + (cycles - 1) * task.every + 1

    def describe_rack(self) -> Document:
        """Describe the held rack: its tick, and state, row of a table and reason of each level."""
        levels = [
            {"level": row.task, "state": row.state, "row": row.row, "reason": row.reason}
            for row in RackMonitor(self._segment).take_snapshot().tasks
            if row.task in self._executors
        ]
        tick = self._words[System.HELD] - 1
        time_s = tick * self._segment.layout.clock_ns * 1e-9
        return {"rack": self._segment.rack, "tick": tick, "time_s": time_s, "levels": levels}

    def _await_hold_at(self, tick: int) -> int:
        """Wait until the rack is held before `tick` or a later one, and return that tick."""
        while (held_tick := self._words[System.HELD] - 1) < tick:
            if self._segment.run_is_over:
                raise Failure(
                    f"rack '{self._segment.rack}': its run ended at tick {self._words[System.TICK]}"
                )
            time.sleep(CHECK_INTERVAL_S)
        return held_tick


class Pause(NamedTuple):
    """A pause of a rack.

    Attributes:
        tick: In lockstep the tick before which the rack is held, otherwise the tick at which the
            hold was complete.
        levels: Levels that are held. Empty in lockstep.
    """

    tick: int
    levels: list[str]


def pause_rack(segment: Segment) -> Pause:
    """Pause a rack, and return once it is held or its arm is at rest.

    Raises `Failure` if the hold is refused, or if no single level is above all others.
    """
    if segment.words[System.LOCKSTEP]:
        return Pause(Stepper(segment).hold_rack(), [])
    desk = LevelCommander(segment)
    levels = desk.list_highest_levels("", "hold")
    if len(levels) != 1:
        highest = ", ".join(levels) or "none"
        needed = "one of the levels that can hold must be above all others"
        raise Failure(f"rack '{segment.rack}' runs in real time: {needed}; highest: {highest}")
    reply = desk.give_command({"level": levels[0], "what": "hold"}, wait=True)
    if reply.fate != "done":
        raise Failure(reply.line)
    return Pause(reply.done, levels)


def resume_rack(segment: Segment) -> list[str]:
    """Let a paused rack continue. Returns the levels that were held.

    Raises `Failure` if the rack is not paused.
    """
    words = segment.words
    levels: list[str] = []
    if words[System.LOCKSTEP]:
        is_paused = words[System.HOLD_AT] > 0
        words[System.HOLD_AT] = 0
    else:
        desk = LevelCommander(segment)
        levels = desk.list_highest_levels("hold")
        is_paused = bool(levels)
        for level in levels:
            reply = desk.give_command({"level": level, "what": "resume"}, wait=False)
            if not reply.worked:
                raise Failure(reply.line)
    if not is_paused:
        raise Failure(f"rack '{segment.rack}' is not paused")
    return levels
