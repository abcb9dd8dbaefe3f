"""The host's end of all alarm rings: what tasks and clock have rung, as events in order of time."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from rack.backplane.address_map import CLOCK
from rack.backplane.alarms import Alarm, alarm_ring
from rack.backplane.fault_table import FaultTable
from rack.backplane.operator_table import OperatorTable, RequestEntry
from rack.backplane.segment import Segment
from rack.boards.alarm_text import event_of
from rack.boards.config.cell import geom_name
from rack.boards.config.schema import RackConfig
from rack.boards.events import Event
from rack.boards.operating.command import describe, level_of, message_of
from rack.levels.operator import Operation


class Heard(NamedTuple):
    """One alarm: its code, its subject (see `Alarm`), and the event that it makes."""

    alarm: Alarm
    subject: int
    event: Event


class AlarmWatch:
    """Reads the alarm rings of one rack. `lost` counts alarms that were overwritten unread."""

    def __init__(self, segment: Segment, config: RackConfig) -> None:
        self._layout, self._faults, self._operator = segment.layout, FaultTable(segment), OperatorTable(segment)
        self._config = config
        self._joints = config.robot.joints if config.robot is not None else ()
        self._rings = {name: alarm_ring(segment, name) for name in (CLOCK, *(t.name for t in segment.layout.tasks))}
        self.lost = 0

    def drain(self) -> list[Heard]:
        """Return what was rung since the last call."""
        heard = []
        for owner, ring in self._rings.items():
            if not ring.waiting:
                continue
            rows, lost = ring.drain()
            self.lost += lost
            heard += [Heard(Alarm(int(row["code"])), int(row["subject"]), self._event(row, owner)) for row in rows]
        return sorted(heard, key=lambda one: one.event.time_ns)

    def _event(self, row: np.void, owner: str) -> Event:
        if row["code"] == Alarm.COMMANDED:
            return self._command(row, self._operator.entries[int(row["subject"])])
        return event_of(row, owner, self._layout, self._faults, self._joints, self._geom)

    def _command(self, row: np.void, entry: RequestEntry) -> Event:
        """Return the event of a command that was given."""
        level, message, serial = level_of(entry, self._layout), message_of(entry, self._layout), int(row["value"])
        text, code = f"{describe(message)} (command {serial})", Operation(message.what).name.lower()
        realtime_ns = int(row["time_ns"]) + time.time_ns() - time.monotonic_ns()
        return Event(realtime_ns, int(row["tick"]), "command", level, text, code, subject=level, value=serial)

    def _geom(self, geom: int) -> str:
        """Return the name of a geom of the cell, which is built for the first collision."""
        config = self._config
        return geom_name(config.robot, config.scene, config.clock_ns, geom) if config.robot is not None else str(geom)
