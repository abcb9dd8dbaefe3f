"""Levels for tests of faults: one has sensors and motors that can fail, one follows a wave."""

from __future__ import annotations

from wave_levels import Watch

from rack.backplane.message import State, Status, field
from rack.levels.fault_steps import CommandStep, MotorStep, SensorStep, TendonStep
from rack.levels.level import Executor, LevelContext, Output


class Place(Status, version=1):
    position: float = field(unit="rad", doc="where it is")
    mode: int = field("i2", unit="1", doc="how it moves")


class Driven(Executor):
    """Reports that it stands still."""

    status = Output(Place)
    faults = (SensorStep, MotorStep, CommandStep, TendonStep)

    def process(self, tick: int) -> None:
        self.status.position = 0.5


class Follower(Watch):
    """Holds while the wave is silent, and fails after `patience` ticks."""

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._patience = context.params["patience"]
        self._since: int | None = None
        self._latched = ""

    def process(self, tick: int) -> None:
        """Follow the wave, wait for it, or give up."""
        super().process(tick)
        self._since = (
            (self._since or tick) if self.below.has_message and self.below.is_lost else None
        )
        if self._since is not None and tick - self._since > self._patience:
            self._latched = f"nothing heard of the wave for {tick - self._since} ticks"
        waits = f"waiting for the wave; latched at tick {(self._since or 0) + self._patience}"
        self.status.reason = self._latched or (waits if self._since is not None else "")
        self.status.state = (
            State.ERROR
            if self._latched
            else State.HOLDING
            if self._since is not None
            else State.EXECUTING
        )
