"""Decides in every cycle whether the arm follows its set points or stops, and for how long."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Demand
from rack.levels.level import Finding
from rack.levels.messages import ArmState, Error
from rack.levels.servo.control import ArmParams
from rack.levels.servo.sensor_monitor import SensorMonitor


class Reaction(IntEnum):
    """Reactions of the servo level; the greater, the stronger."""

    NONE = 0  # follow the set points
    HOLD = 1  # ramp to rest, hold with torques
    STOP = 2  # ramp to rest, then brake
    BRAKE = 3  # brake at once


DEMANDED = {Demand.NONE: Reaction.NONE, Demand.STOP: Reaction.STOP, Demand.BRAKE: Reaction.BRAKE}


class Cause(NamedTuple):
    """A fault that keeps the arm from its set points."""

    error: Error
    text: str  # the fault, readable
    joint: int = -1
    value: float = 0.0  # measured: rad, N m or ticks, by error
    then: str = ""  # the next step, readable


class Stopping:
    """Weighs the rack's demands, faults of sensors, motors and torques, and blows: the strongest
    reaction wins.

    A failed motor is retried after a while: the arm holds with it, and follows set points after
    `good_cycles` without a fault. If it fails while the arm ramps or holds with it, the brakes
    engage. An arm that was struck, or pressed too hard, stays stopped until nothing has for the
    same time.

    Faults may keep the arm from its set points for `patience`. That time counts up during faults
    and down while the arm follows, so recurring faults use it up too. Then the fault is latched:
    the brakes stay engaged.
    """

    def __init__(self, params: ArmParams, joints: Sequence[str], tick_s: float, every: int) -> None:
        self._joints = joints
        self._params = params
        self._every = every
        self._on_sensors = Reaction[params.on_sensor_fault.upper()]
        self._on_motors = Reaction[params.on_actuator_fault.upper()]
        self._retry_ticks = round(params.retry / tick_s)
        self._good_ticks = params.good_cycles * every
        self._most = max(round(params.patience / tick_s), every)
        self.refused: Finding | None = None  # the last cycle's torque, if the arm refused it
        self.error = Error.NONE  # latched fault
        self.cause = Error.NONE  # fault that keeps the arm from its set points
        self.reason = ""  # why the arm does not follow its set points, in one line; empty: it does
        self.findings: list[Finding] = []  # new ones, one per episode; the reader clears it
        self._kept = 0  # ticks for which faults have kept the arm from its set points
        self._remembered: tuple[int, Error] | None = None  # in the last state
        self._tick: int | None = None
        self._retry_at: int | None = (
            None  # tick at which a failed motor is retried; None: none has failed
        )
        self._on_failure = self._on_motors  # reaction until then
        self._motor = self._blow = Cause(Error.NONE, "")
        self._struck_until: int | None = None  # tick until which a struck arm stays stopped
        self._on_blow = Reaction.BRAKE  # reaction until then

    def recall(self, state: ArmState) -> None:
        """Continue from the state in an `ARM_STATE`."""
        self._tick = state.tick
        self._kept = state.kept
        if state.error != Error.DISABLED:
            self.error = Error(state.error)
            self.reason = state.reason

    def remember(self, state: ArmState) -> None:
        """Fill in the state for `recall`."""
        error = self.error or (Error.DISABLED if self.is_disabled else Error.NONE)
        if (self._kept, error) != self._remembered:
            self._remembered = self._kept, error
            state.kept = self._kept
            state.error = error
            state.reason = self.reason if self.error else ""

    @property
    def is_disabled(self) -> bool:
        """Whether the arm is not enabled, and nothing worse is known."""
        return self.cause in (Error.DISABLED, Error.DRIVES)

    @property
    def trying(self) -> bool:
        """Whether a motor is at fault, or not yet known to be sound again."""
        return self._retry_at is not None

    def motor_fails(self, joint: int, lacking: float, tick: int) -> Reaction:
        """Register a motor that lacks `lacking` N m of its torque; return the reaction."""
        self._on_failure = self._on_motors if self._retry_at is None else Reaction.BRAKE
        self._retry_at = tick + self._retry_ticks
        text = f"motor of '{self._joints[joint]}' does not give the torque commanded"
        self._motor = Cause(
            Error.MOTORS, text, joint, lacking, f"; tried again at tick {self._retry_at}"
        )
        self._wait_for(self._motor, tick)
        return self._on_failure

    def refuse(self, finding: Finding, tick: int) -> None:
        """Register a torque that the arm refused."""
        self.refused = finding
        self._wait_for(self._about_torque(finding), tick)

    def stop_for(
        self, blow: Cause, finding: Finding, tick: int, reaction: Reaction = Reaction.BRAKE
    ) -> None:
        """Register a blow: a contact that is unintended or too strong, or a joint beyond its limit;
        with the reaction to it.
        """
        is_new = self._struck_until is None or blow.error is not self._blow.error
        # The arm may have reported it by itself, in this cycle.
        if is_new and all(one.alarm is not finding.alarm for one in self.findings):
            self.findings.append(finding)
        self._on_blow = reaction if self._struck_until is None else max(self._on_blow, reaction)
        self._struck_until = tick + self._retry_ticks
        self._blow = blow

    def wait(self, error: Error, why: str, tick: int) -> Reaction:
        """Return the reaction of this cycle while the arm is not enabled, which no patience
        bounds: `error` is DISABLED or DRIVES.
        """
        self._tick = tick
        if not self.error:
            self.cause = error
            self.reason = why
        return Reaction.BRAKE

    def decide(self, demand: Demand, sensors: SensorMonitor, tick: int) -> Reaction:
        """Return the reaction of this cycle."""
        passed = tick - self._tick if self._tick is not None else self._every
        self._tick = tick
        if self.is_disabled:
            self.cause = Error.NONE
        if self.error:
            return Reaction.BRAKE
        sound = self.refused is None and self._retry_at is None and self._struck_until is None
        if sound and not (sensors.faulty or demand):
            self._kept = max(self._kept - passed, 0) if self._kept else 0
            self.cause = Error.NONE
            self.reason = ""
            return Reaction.NONE
        reaction, cause = self._weigh(sensors, tick)
        if cause is None:
            self._kept = max(self._kept - passed, 0)
        elif not demand:
            self._kept += passed
            if self._kept >= self._most:
                # Latch the fault: the brakes stay engaged.
                self.error = self.cause = cause.error
                self.reason = f"{cause.text}; not over within {self._params.patience:g} s"
                self.findings.append(Finding(Alarm.LATCHED, cause.joint, cause.value))
                return Reaction.BRAKE
        if demand:
            self.reason = (
                f"demand '{demand.name.lower()}' on the arm, until boards and emergency stop are in"
                " order"
            )
        elif cause is not None:
            self._wait_for(cause, tick)
        else:
            self.cause = Error.NONE
            self.reason = ""
        return max(reaction, DEMANDED[demand]) if demand else reaction

    def _wait_for(self, cause: Cause, tick: int) -> None:
        """Set `cause` and `reason`: the fault that must end, and the tick at which it is
        latched.
        """
        self.cause = cause.error
        self.reason = f"{cause.text}{cause.then}; latched at tick {tick + self._most - self._kept}"

    def _weigh(self, sensors: SensorMonitor, tick: int) -> tuple[Reaction, Cause | None]:
        """Return the reaction to faults, and the fault to report."""
        reaction = Reaction.NONE
        cause = None if self.refused is None else self._about_torque(self.refused)
        if sensors.faulty:
            reaction = self._on_sensors if sensors.drivable else Reaction.BRAKE
            cause = self._about_sensors(sensors)
        if self._retry_at is not None:
            if tick >= self._retry_at + self._good_ticks:
                self._retry_at = None
            else:
                on_motors = self._on_failure if tick < self._retry_at else Reaction.HOLD
                reaction = max(reaction, on_motors)
                cause = self._motor
        if self._struck_until is not None:
            if tick < self._struck_until:
                return max(reaction, self._on_blow), self._blow
            self._struck_until = None
        return reaction, cause

    def _about_sensors(self, sensors: SensorMonitor) -> Cause:
        joint, read, off = sensors.blamed
        if joint < 0:
            return Cause(Error.SENSORS, sensors.missing, joint, read)
        text = f"sensor of '{self._joints[joint]}' reads {read:.4g} rad"
        if off == off:  # known: not NaN
            text = f"{text}, off by {off:.3g}"
        return Cause(Error.SENSORS, text, joint, read)

    def _about_torque(self, refused: Finding) -> Cause:
        what = (
            "not finite" if refused.alarm is Alarm.COMMAND_INVALID else f"{refused.value:.3g} N m"
        )
        text = f"rejected: torque of '{self._joints[refused.subject]}' is {what}"
        if refused.alarm is Alarm.SET_POINT:
            what = f"{refused.value:.3g} rad from the joint"
            text = f"rejected: set point of '{self._joints[refused.subject]}' is {what}"
        return Cause(Error.LIMIT, text, refused.subject, refused.value)
