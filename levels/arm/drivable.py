"""Interface of an arm to the servo level."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import ClassVar, NamedTuple, Protocol

from rack.levels.algebra import Array
from rack.levels.level import Fault, Finding
from rack.levels.messages import ArmState, Scene
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.tables import Interface, SceneConfig, SensorConfig, validate_class


class DriveState(IntEnum):
    """State of an arm's drives: the CiA 402 states, reduced to what levels distinguish."""

    DISABLED = 0  # up to "switched on", without a request: no power, brakes engaged
    ENABLING = 1  # on the way to "operation enabled", including homing
    ENABLED = 2  # "operation enabled": torques act, unlike in "quick stop active"
    FAULT = 3  # "fault reaction active" and "fault", until `Arm.reset`


class Sensed(NamedTuple):
    """One sample of the arm's sensors.

    Joint values have the resolution and noise of the encoders.
    """

    position: Array  # (joints,), rad
    velocity: Array  # (joints,), rad/s
    opening: float  # gripper joint, m; 0 without a gripper
    opening_velocity: float  # m/s
    tick: int  # tick of the sample; if older than the cycle's, there is no new sample


class JointTarget(NamedTuple):
    """Set points of the joints for the end of a cycle. Arrays are (joints,)."""

    position: Array  # rad
    velocity: Array  # rad/s; for velocity drives, corrected for the position error
    torque: Array  # N m: predicted for the motion, including the payload


class LimitViolation(NamedTuple):
    """Violation of a joint limit by a sample."""

    finding: Finding
    text: str  # description for the user


def copy_sample(sample: Sensed) -> Sensed:
    """Return a copy of a sample; its arrays stay valid when the next sample is taken."""
    return sample._replace(position=sample.position.copy(), velocity=sample.velocity.copy())


class Link(Protocol):
    """The connection between the servo level and an arm."""

    def sense(self) -> Sensed:
        """Return the newest sample. The arrays are valid until the next call."""

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Release the brakes and apply torques for one torque cycle.

        If a torque must not be applied (see `BrakedArm.refused`), the brakes engage instead.

        Args:
            torque: Joint torques, (joints,), N m.
            grip_force: Force of the gripper, N.

        Returns:
            The reason why the torque was refused, or None if it was applied.
        """

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        """Release the brakes and make the drives reach `target` at the end of the cycle.

        After the end of the cycle, the drives continue at the velocity of `target`. For
        `grip_force` and the result see `drive`.
        """


class FaultyPath(Link, Protocol):
    """Link with injected faults."""

    def inject(self, faults: Sequence[Fault]) -> None:
        """Make `faults` the active faults, instead of the previous ones."""


class ArmLinks(NamedTuple):
    """Links between the servo level and an arm, without and with injected faults."""

    faultless: Link
    faulty: FaultyPath


class DrivableArm(ABC):
    """An arm whose joints have drives and brakes, and a force-controlled gripper.

    The drives, or the link that `connect` returns, enforce the limits. Derive an arm from
    `rack.levels.arm.Arm` rather than from this class: `Arm` implements the link, the counters and
    the reports.
    """

    keeps_limits: ClassVar[bool]
    """True if its drives keep positions and velocities within the limits by themselves."""
    sensors: ClassVar[SensorConfig]
    """Its encoders, unless `[robot.sensors]` states them."""
    reports_torque = False
    """True if `torque` is the torque of the motors for the coming cycle after `follow`.

    Otherwise it is the predicted torque, and only the following error shows that a motor has
    failed.
    """
    exceeded: LimitViolation | None = None
    """Limit that the newest sample exceeds. None if it exceeds none or the link checks none."""

    dynamics: Dynamics  # for the level that drives the arm
    tick: int  # present tick
    late_s: float  # s: in lockstep, time by which the clock is late for the present cycle
    state: DriveState  # of the drives, after the last `step`
    torque: Array  # (joints,), N m: last torque of the motors
    grip_force: float  # N: last force of the gripper
    braked: bool  # True while the brakes are engaged
    brake_cause: int  # cause if brakes engage in this cycle, see `Alarm.BRAKES_CLOSED`
    fault: str  # why the arm has failed and cannot move. Empty if it has not
    contact: tuple[int, int] | None  # geoms of an unintended contact of arm or load in a step
    clipped: int  # cycles in which a command was refused or cut
    touches: int  # unintended contacts so far
    first_touch: str  # description of the first unintended contact
    violations: int  # steps in which the drives broke a limit of position, velocity or torque
    first_violation: str  # description of the first violation
    pushed: int  # steps in which a blow pushed a joint beyond a limit of position or velocity

    @abstractmethod
    def __init__(
        self, cell: Cell, scene: SceneConfig, clock_ns: int, every: int = 1, seed: int = 0
    ) -> None:
        """Start with engaged brakes at the start position.

        Args:
            cell: The arm and its surroundings.
            scene: The `[scene]` table.
            clock_ns: Duration of a tick, ns.
            every: Length of a torque cycle, ticks.
            seed: Seed of the random noise.
        """

    @abstractmethod
    def connect(
        self,
        tick_s: float,
        speed_fraction: float,
        acted: dict[int, bool],
        holds: Callable[[], bool],
    ) -> ArmLinks:
        """Return the links through which the servo level drives the arm.

        Args:
            tick_s: Duration of a tick, s.
            speed_fraction: Fraction of the velocity limits that is permitted.
            acted: Receives the faults that have an effect, for `Executor.acted`.
            holds: Function that returns True if, as far as the level knows, the gripper may hold an
                object.

        Raises:
            RobotError: The encoders are too coarse to detect a violated limit.
        """

    @abstractmethod
    def permit_speed(self, speed_fraction: float) -> None:
        """Set the fraction of the velocity limits that the link permits."""

    @classmethod
    @abstractmethod
    def find_connect_error(cls, cell: Cell, speed_fraction: float) -> str:
        """Return the reason why `connect` would fail for a cell, or an empty string.

        Called before the launch.
        """

    @classmethod
    @abstractmethod
    def has_interface(cls, interface: Interface) -> bool:
        """Return True if the drives accept commands of type `interface`.

        `rack check` refuses a config that names another type.
        """

    @abstractmethod
    def brake(self) -> None:
        """Engage the brakes, which stop and hold the joints.

        The motors apply no torque, and the gripper keeps its force.
        """

    @abstractmethod
    def step(self, ticks: int) -> None:
        """Advance `tick` and `waited` by `ticks`, and brake once `waited` reaches `patience`.

        A simulation also simulates these ticks. After missed cycles, `ticks` is more than one cycle
        of the level. It may be 0.
        """

    @abstractmethod
    def report_braking(self) -> None:
        """Report a finding if the arm has engaged its brakes by itself since the last cycle."""

    @abstractmethod
    def enable(self) -> None:
        """Request that the drives be enabled, without blocking.

        `state` becomes ENABLED in a later `step`. While the arm is not enabled, it is braked in
        every cycle.
        """

    @abstractmethod
    def disable(self) -> None:
        """Request that the drives be disabled."""

    @abstractmethod
    def reset(self) -> None:
        """Request that drives in FAULT change to DISABLED, and clear `fault`."""

    @abstractmethod
    def describe_contact(self, contact: tuple[int, int]) -> str:
        """Describe a `contact` as text."""

    @abstractmethod
    def sense_wrist(self) -> Array | None:
        """Return the newest force in N and torque in N m at the wrist, (6,), in the sensor's frame.

        Return None if the arm has no wrist sensor.
        """

    @abstractmethod
    def look(self, scene: Scene) -> None:
        """Fill a `Scene` with the sensed poses of bodies and tool."""

    @abstractmethod
    def save(self, state: ArmState) -> None:
        """Fill an `ArmState` with the state that a restarted board needs."""

    @abstractmethod
    def restore(self, state: ArmState) -> None:
        """Continue from an `ArmState`.

        Called once on a restarted board, before the first `step`.
        """


def find_arm(reference: str) -> type[DrivableArm]:
    """Return the class of an arm, given a reference "package.module:Class".

    Raises:
        ValueError: The class is missing, abstract, or not the class of an arm.
    """
    return validate_class(reference, DrivableArm)
