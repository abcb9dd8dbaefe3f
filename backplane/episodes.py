"""Alarms about one mailbox, rung once an episode: however long a fault lasts, its watcher tells of it once."""

from __future__ import annotations

from rack.backplane.alarms import Alarm, AlarmWriter
from rack.backplane.segment import Segment

CLEAN = 20
"""Accesses, and cycles of the writer, without a finding, after which the next one begins a new episode."""


class Episodes:
    """The findings about one mailbox, each with the access and the tick at which it was last made."""

    def __init__(self, segment: Segment, name: str, alarms: AlarmWriter) -> None:
        self._subject = [spec.name for spec in segment.layout.mailboxes].index(name)
        self._clean_ticks = CLEAN * segment.layout.mailbox(name).every
        self._alarms = alarms
        self._last: dict[Alarm, tuple[int, int]] = {}

    def find(self, code: Alarm, access: int, tick: int, value: float = 0.0, since: int | None = None) -> None:
        """Note a finding in an access, counted by the caller; ring when it begins an episode."""
        if not self.is_open(code, access, tick):
            self.ring(code, tick, value, since)
        self._last[code] = access, tick

    def ring(self, code: Alarm, tick: int, value: float = 0.0, since: int | None = None) -> None:
        """Ring at once: for a finding whose episodes the caller knows."""
        self._alarms.ring(tick, code, self._subject, value, since)

    def is_open(self, code: Alarm, access: int, tick: int) -> bool:
        """Say whether an episode lasts."""
        if code not in self._last:
            return False
        last_access, last_tick = self._last[code]
        return access - last_access <= CLEAN or tick - last_tick <= self._clean_ticks
