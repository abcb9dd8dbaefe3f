"""Tells when the brakes close and open."""

from __future__ import annotations

from rack.backplane.watch.alarms import Alarm
from rack.levels.arm import Arm
from rack.levels.level import Finding


class BrakeLog:
    """Watches the brakes of one arm: a finding when they close, and when they open."""

    def __init__(self, arm: Arm, every: int) -> None:
        self._arm, self._every = arm, every
        self._closed_at: int | None = None

    def start(self, tick: int) -> None:
        """Begin at `tick`, with brakes that are closed because no torque has ever been given."""
        self._closed_at = tick

    def after_waiting(self, tick: int, findings: list[Finding]) -> None:
        """Tell that the brakes closed because torques did not come, up to `tick`."""
        if self._arm.braked and self._closed_at is None:
            missed = self._arm.waited - self._every
            self._closed_at = tick
            findings.append(Finding(Alarm.BRAKES_CLOSED, -1, missed))

    def after_cycle(self, tick: int, findings: list[Finding]) -> None:
        """Tell what the cycle at `tick` did to the brakes."""
        if not self._arm.braked:
            if self._closed_at is not None and tick > self._closed_at:
                findings.append(Finding(Alarm.BRAKES_OPENED, -1, tick - self._closed_at))
            self._closed_at = None
        elif self._closed_at is None:
            self._closed_at = tick
            findings.append(Finding(Alarm.BRAKES_CLOSED, -1, 0))
