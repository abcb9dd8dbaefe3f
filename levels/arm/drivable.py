"""What the servo level asks of an arm."""

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
from rack.levels.tables import Interface, SceneConfig, SensorConfig, named_class


class DriveState(IntEnum):
    """State of an arm's drives: those of CiA 402, reduced to what a level above must tell apart."""

    DISABLED = 0  # up to "switched on", without a request: no power, brakes engaged
    ENABLING = 1  # asked for: on the way to "operation enabled", homing included
    ENABLED = 2  # "operation enabled": torques act; in "quick stop active" none would
    FAULT = 3  # "fault reaction active" and "fault": until `Arm.reset`


class Sensed(NamedTuple):
    """One sample of the arm's sensors; joints are as coarse and noisy as their encoders."""

    position: Array  # (joints,), rad
    velocity: Array  # (joints,), rad/s
    opening: float  # gripper joint, m; 0 without a gripper
    opening_velocity: float  # m/s
    tick: int  # of the sample: an older one than that of the cycle counts as no new sample


class JointTarget(NamedTuple):
    """Set points of the joints for the end of a cycle; arrays are (joints,)."""

    position: Array  # rad
    velocity: Array  # rad/s; for drives of velocity corrected by the error of the position
    torque: Array  # N m: predicted for the motion, payload included


class Exceeded(NamedTuple):
    """A limit that a joint is beyond: what found it, and in words."""

    finding: Finding
    text: str


def copied(sample: Sensed) -> Sensed:
    """Return a sample whose arrays stay valid."""
    return sample._replace(position=sample.position.copy(), velocity=sample.velocity.copy())


class Link(Protocol):
    """The path between the servo level and an arm: samples come up, torques or set points go
    down.
    """

    def sense(self) -> Sensed:
        """Return the newest sample. The arrays are valid until the next call."""

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Release the brakes and apply torques, (joints,), N m, and the gripper's force, N, for one
        torque cycle.

        A torque that must not be applied (see `Arm.refused`) engages the brakes, and the finding is
        returned.
        """

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        """Release the brakes, and let the drives be at `target` in one cycle; then they go on at
        that velocity. Otherwise as `drive`.
        """


class FaultyPath(Link, Protocol):
    """The same path with injected faults."""

    def inject(self, faults: Sequence[Fault]) -> None:
        """Replace the active faults."""


class ArmLinks(NamedTuple):
    """The path between the servo level and an arm, in use without and with injected faults."""

    sound: Link
    faulty: FaultyPath


class DrivableArm(ABC):
    """An arm whose joints have drives and brakes, and a force-driven gripper.

    Its limits are kept by its own drives, or by the link that `connect` returns. Subclass
    `rack.levels.arm.Arm`, which has that link, the counters and the reports.
    """

    keeps_limits: ClassVar[bool]
    """Whether its drives keep positions and velocities within the limits by themselves."""
    sensors: ClassVar[SensorConfig]
    """Its encoders, where `[robot.sensors]` does not say."""
    reports_torque = False
    """Whether, after `follow`, `torque` is what the motors give throughout the coming cycle. Else
    it is what was predicted, and only the following error tells that a motor has failed."""
    exceeded: Exceeded | None = None
    """The limit that the newest sample is beyond, where the link judges samples."""

    dynamics: Dynamics  # for the level that drives the arm
    tick: int  # of the state
    state: DriveState  # of the drives, as of the last `step`
    torque: Array  # (joints,), N m: given to the motors last
    grip_force: float  # N: given to the gripper last
    braked: bool  # the brakes are engaged
    brake_cause: int  # of brakes that engage in this cycle: see their alarm
    fault: str  # why it has failed and moves no more; empty: it has not
    contact: tuple[int, int] | None  # geoms of an unintended contact, of it or its load, in a step
    clipped: int  # cycles in which a command was refused or cut
    touches: int  # unintended contacts so far
    first_touch: str  # the first of them, readable: which geoms, and when
    violations: int  # steps in which the drives broke a limit of position, velocity or torque
    first_violation: str  # the first of them, readable: which limit, by how much, and when
    pushed: int  # steps in which a blow pushed a joint beyond a limit of position or velocity

    @abstractmethod
    def __init__(
        self, cell: Cell, scene: SceneConfig, clock_ns: int, every: int = 1, seed: int = 0
    ) -> None:
        """Start braked at home. One tick is `clock_ns`, one torque cycle `every` ticks; `seed` is
        for random noise.
        """

    @abstractmethod
    def connect(
        self, tick_s: float, part: float, acted: dict[int, bool], holds: Callable[[], bool]
    ) -> ArmLinks:
        """Return the path that the servo level drives it through.

        Args:
            tick_s: One tick, s.
            part: Part of their limits within which velocities are kept.
            acted: Collects the faults that act, for `Executor.acted`.
            holds: Whether the gripper holds a part, for all that the level knows.

        Raises:
            RobotError: Encoders are too coarse to tell a limit.
        """

    @abstractmethod
    def permit(self, part: float) -> None:
        """Let the path keep velocities within another `part` of their limits."""

    @classmethod
    @abstractmethod
    def misfit(cls, cell: Cell, part: float) -> str:
        """Return why `connect` would fail for a cell, before the launch; empty: it would not."""

    @classmethod
    @abstractmethod
    def takes(cls, interface: Interface) -> bool:
        """Return whether the drives have an interface: `rack check` refuses a config that names
        another.
        """

    @abstractmethod
    def brake(self) -> None:
        """Engage the brakes: they stop and hold the joints, motors give no torque, the gripper
        keeps its force.
        """

    @abstractmethod
    def step(self, ticks: int) -> None:
        """Let `ticks` ticks pass: advance `tick` and `waited` (all that hardware does), and keep to
        `patience`.

        `ticks` exceeds the level's cycle after missed cycles, and may be 0.
        """

    @abstractmethod
    def report_waiting(self) -> None:
        """Add to the findings that the arm has engaged its brakes by itself, between two cycles."""

    @abstractmethod
    def enable(self) -> None:
        """Ask the drives for torque; does not block: `state` becomes ENABLED in a later `step`.

        Until then, and whenever the arm is not enabled, it is braked in every cycle.
        """

    @abstractmethod
    def disable(self) -> None:
        """Ask the drives to give no torque any more."""

    @abstractmethod
    def reset(self) -> None:
        """Ask drives in FAULT to leave it, for DISABLED, and clear `fault`, which says why they
        were in it.
        """

    @abstractmethod
    def named(self, contact: tuple[int, int]) -> str:
        """Return a `contact` in words."""

    @abstractmethod
    def feel(self) -> Array | None:
        """Return the newest sample of the wrist sensor, (6,), N, N m, in its frame. None: it has
        none.
        """

    @abstractmethod
    def look(self, scene: Scene) -> None:
        """Fill a `SCENE` with the poses of bodies and tool."""

    @abstractmethod
    def save(self, state: ArmState) -> None:
        """Fill an `ARM_STATE` with the state that a restarted board needs."""

    @abstractmethod
    def restore(self, state: ArmState) -> None:
        """Continue from an `ARM_STATE`: called once, before the first `step`, on a restarted
        board.
        """


def find_arm(reference: str) -> type[DrivableArm]:
    """Return the class that "package.module:Class" names. Raises `ValueError` where it is missing
    or no whole arm.
    """
    return named_class(reference, DrivableArm)
