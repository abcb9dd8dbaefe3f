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
    """Reactions of the servo level, in order of strength."""

    NONE = 0  # follow the set points
    HOLD = 1  # ramp to rest, hold with torques
    STOP = 2  # ramp to rest, then brake
    BRAKE = 3  # brake at once


class Cause(NamedTuple):
    """A fault that keeps the arm from following its set points."""

    error: Error
    text: str  # describes the fault
    joint: int = -1
    value: float = 0.0  # measured, in rad, N m or ticks, depending on the error
    then: str = ""  # describes the next step


class Stopping:
    """Selects the strongest of the reactions to demands of the rack, to faults and to blows.

    A blow is an unintended or too strong contact, or a joint beyond its limit. After a blow the arm
    stays stopped until `retry` has passed without another one.

    A failed motor is retried after `retry`: the arm holds with it, and follows set points after
    `good_cycles` without a fault. If the motor fails again before that, the brakes engage.

    Faults may keep the arm from its set points for `patience`. That time counts up during faults
    and down while the arm follows its set points, so recurring faults use it up too. At its
    end the fault is latched, and the brakes stay engaged.

    Attributes:
        refused: Finding about the last cycle's torque or set point, if the arm refused it.
        error: The latched fault, or NONE.
        cause: The fault that keeps the arm from its set points, or NONE.
        reason: Why the arm does not follow its set points, in one line, or empty.
        findings: New findings, one per episode. The reader clears the list.
    """

    def __init__(self, params: ArmParams, joints: Sequence[str], tick_s: float, every: int) -> None:
        """Weigh faults of an arm.

        Args:
            params: Parameters of the board.
            joints: Names of the joints.
            tick_s: Duration of a tick.
            every: Ticks from cycle to cycle.
        """
        self._joints = joints
        self._params = params
        self._every = every
        self._retry_ticks = round(params.retry / tick_s)
        self._patience_ticks = max(round(params.patience / tick_s), every)
        self.refused: Finding | None = None
        self.error = Error.NONE
        self.cause = Error.NONE
        self.reason = ""
        self.findings: list[Finding] = []
        self._fault_ticks = 0  # ticks for which faults have kept the arm from its set points
        self._remembered: tuple[int, Error] | None = None  # values in the last state
        self._tick: int | None = None
        # Tick at which a failed motor is retried. None if no motor has failed.
        self._retry_at: int | None = None
        self._on_failure = Reaction.BRAKE  # reaction until the retry
        self._motor = self._blow = Cause(Error.NONE, "")
        self._struck_until: int | None = None  # tick until which a struck arm stays stopped
        self._on_blow = Reaction.BRAKE  # reaction until that tick

    def restore_state(self, state: ArmState) -> None:
        """Continue from an `ArmState` after a restart."""
        self._tick = state.tick
        self._fault_ticks = state.kept
        if state.error != Error.DISABLED:
            self.error = Error(state.error)
            self.reason = state.reason

    def save_state(self, state: ArmState) -> None:
        """Write the state that `restore_state` needs, if it has changed."""
        error = self.error or (Error.DISABLED if self.is_disabled else Error.NONE)
        if (self._fault_ticks, error) != self._remembered:
            self._remembered = self._fault_ticks, error
            state.kept = self._fault_ticks
            state.error = error
            state.reason = self.reason if self.error else ""

    @property
    def is_disabled(self) -> bool:
        """True if the arm is not enabled, and no fault has a higher priority."""
        return self.cause in (Error.DISABLED, Error.DRIVES)

    def register_motor_failure(self, failed: Finding, tick: int) -> Reaction:
        """Register a failed motor. Its finding is reported unless the motor is being retried.

        Args:
            failed: Finding that names the joint of the motor, and the torque in N m that it lacks.
            tick: Tick of the cycle.

        Returns:
            The reaction of this cycle.
        """
        self._on_failure = Reaction.BRAKE
        if self._retry_at is None:
            self._on_failure = Reaction[self._params.on_actuator_fault.upper()]
            self.findings.append(failed)
        self._retry_at = tick + self._retry_ticks
        text = f"motor of '{self._joints[failed.subject]}' does not give the torque commanded"
        then = f"; tried again at tick {self._retry_at}"
        self._motor = Cause(Error.MOTORS, text, failed.subject, failed.value, then)
        self._set_cause(self._motor, tick)
        return self._on_failure

    def register_refusal(self, finding: Finding, tick: int) -> None:
        """Register a torque or set point that the arm refused."""
        self.refused = finding
        self._set_cause(self._describe_refusal(finding), tick)

    def register_blow(
        self, blow: Cause, finding: Finding, tick: int, reaction: Reaction = Reaction.BRAKE
    ) -> None:
        """Register a contact that is unintended or too strong, or a joint beyond its limit.

        Args:
            blow: Cause to report.
            finding: Finding to report, once per episode.
            tick: Tick of the cycle.
            reaction: Reaction to it.
        """
        is_new = self._struck_until is None or blow.error is not self._blow.error
        # This alarm may have been reported in this cycle already.
        if is_new and all(known.alarm is not finding.alarm for known in self.findings):
            self.findings.append(finding)
        self._on_blow = reaction if self._struck_until is None else max(self._on_blow, reaction)
        self._struck_until = tick + self._retry_ticks
        self._blow = blow

    def wait_for_enabling(self, error: Error, why: str, tick: int) -> Reaction:
        """Return the reaction of this cycle while the arm is not enabled, which is always BRAKE.

        No fault is latched, however long the arm is not enabled.

        Args:
            error: DISABLED or DRIVES.
            why: Why the arm is not enabled.
            tick: Tick of the cycle.
        """
        self._tick = tick
        if not self.error:
            self.cause = error
            self.reason = why
        return Reaction.BRAKE

    def decide_reaction(self, demand: Demand, sensors: SensorMonitor, tick: int) -> Reaction:
        """Return the reaction of this cycle while the arm is enabled.

        Args:
            demand: Stop that the rack demands.
            sensors: Monitor that has checked the sample of this cycle.
            tick: Tick of the cycle.
        """
        passed = tick - self._tick if self._tick is not None else self._every
        self._tick = tick
        if self.is_disabled:
            self.cause = Error.NONE
        if self.error:
            return Reaction.BRAKE
        is_sound = self.refused is None and self._retry_at is None and self._struck_until is None
        if is_sound and not (sensors.faulty or demand):
            self._fault_ticks = max(self._fault_ticks - passed, 0)
            self.cause = Error.NONE
            self.reason = ""
            return Reaction.NONE
        reaction, cause = self._select_reaction(sensors, tick)
        if cause is None:
            self._fault_ticks = max(self._fault_ticks - passed, 0)
        elif not demand:
            self._fault_ticks += passed
            if self._fault_ticks >= self._patience_ticks:
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
            self._set_cause(cause, tick)
        else:
            self.cause = Error.NONE
            self.reason = ""
        return max(reaction, Reaction[demand.name])

    def _set_cause(self, cause: Cause, tick: int) -> None:
        """Set `cause` and `reason`, which contains the tick at which the fault will be latched."""
        self.cause = cause.error
        latch_tick = tick + self._patience_ticks - self._fault_ticks
        self.reason = f"{cause.text}{cause.then}; latched at tick {latch_tick}"

    def _select_reaction(self, sensors: SensorMonitor, tick: int) -> tuple[Reaction, Cause | None]:
        """Return the strongest reaction to the present faults, and the fault to report or None."""
        reaction = Reaction.NONE
        cause = None if self.refused is None else self._describe_refusal(self.refused)
        if sensors.faulty:
            reaction = Reaction.BRAKE
            if sensors.drivable:
                reaction = Reaction[self._params.on_sensor_fault.upper()]
            cause = self._describe_sensor_fault(sensors)
        if self._retry_at is not None:
            if tick >= self._retry_at + self._params.good_cycles * self._every:
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

    def _describe_sensor_fault(self, sensors: SensorMonitor) -> Cause:
        """Describe the fault of the sensors as the cause of a stop."""
        joint, read, offset = sensors.blamed
        if joint < 0:
            return Cause(Error.SENSORS, sensors.missing, joint, read)
        text = f"sensor of '{self._joints[joint]}' reads {read:.4g} rad"
        if offset == offset:  # NaN if unknown
            text = f"{text}, off by {offset:.3g}"
        return Cause(Error.SENSORS, text, joint, read)

    def _describe_refusal(self, refused: Finding) -> Cause:
        """Describe a refused torque or set point as the cause of a stop."""
        quantity = "torque"
        value = f"{refused.value:.3g} N m"
        if refused.alarm is Alarm.COMMAND_INVALID:
            value = "not finite"
        elif refused.alarm is Alarm.SET_POINT:
            quantity = "set point"
            value = f"{refused.value:.3g} rad from the joint"
        text = f"rejected: {quantity} of '{self._joints[refused.subject]}' is {value}"
        return Cause(Error.LIMIT, text, refused.subject, refused.value)
