"""Decides in every cycle whether the arm follows its set points, or what it does instead."""

from __future__ import annotations

from enum import IntEnum

from backplane.words import Demand
from levels.servo.params import ServoParams
from levels.servo.sensor_monitor import SensorMonitor


class Reaction(IntEnum):
    """What the servo level does, the stronger the greater."""

    NONE = 0  # follow the set points
    HOLD = 1  # ramp to rest, hold with torques
    STOP = 2  # ramp to rest, then brake
    BRAKE = 3  # brake at once


DEMANDED = {Demand.NONE: Reaction.NONE, Demand.STOP: Reaction.STOP, Demand.BRAKE: Reaction.BRAKE}


class Stopping:
    """Weighs demands on the arm, faults of its sensors and faults of its motors: the strongest reaction wins.

    A motor at fault is tried again after a while: the arm holds with it, and follows when that went well for
    `good_cycles`. Where it fails while the arm ramps or holds with it, the brakes close. `reason` says in one line why
    the arm does not follow; empty: it does.
    """

    def __init__(self, params: ServoParams, retry_ticks: int, every: int) -> None:
        self._on_sensors = Reaction[params.on_sensor_fault.upper()]
        self._on_motors = Reaction[params.on_actuator_fault.upper()]
        self._retry_ticks, self._good_ticks = retry_ticks, params.good_cycles * every
        self._retry_at: int | None = None
        self._standing = self._on_motors
        self._motors = ""
        self.reason = ""

    @property
    def trying(self) -> bool:
        """Whether a motor is at fault, or not yet known to be sound again."""
        return self._retry_at is not None

    def motor_fails(self, joint: str, tick: int) -> Reaction:
        """Take in that a motor does not do what it is told; return the reaction."""
        self._standing = self._on_motors if self._retry_at is None else Reaction.BRAKE
        self._retry_at = tick + self._retry_ticks
        self._motors = f"joint '{joint}': the motor does not give the torque it was told"
        return self._standing

    def decide(self, demand: Demand, sensors: SensorMonitor, tick: int) -> Reaction:
        """Return the reaction of this cycle."""
        reaction = DEMANDED[demand]
        self.reason = f"the safety of the rack demands: {demand.name.lower()}" if reaction else ""
        if sensors.faulty:
            reaction = max(reaction, self._on_sensors if sensors.drivable else Reaction.BRAKE)
            self.reason = "the sensors of the arm are not to be trusted"
        if self._retry_at is not None:
            reaction = max(reaction, self._about_motors(self._retry_at, tick))
        return reaction

    def _about_motors(self, retry_at: int, tick: int) -> Reaction:
        if tick >= retry_at + self._good_ticks:
            self._retry_at = None
            return Reaction.NONE
        self.reason = self._motors
        return self._standing if tick < retry_at else Reaction.HOLD
