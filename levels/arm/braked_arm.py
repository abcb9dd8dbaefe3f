"""Behaviour common to all arms: they refuse invalid torques and report braking."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from rack.backplane.watch.alarms import BRAKED_AT_START, BRAKED_WITHOUT_TORQUE, Alarm
from rack.levels.algebra import Array
from rack.levels.arm.link import DriveState, JointTarget, LimitViolation, Sensed
from rack.levels.arm.plant import Plant
from rack.levels.level import Finding
from rack.levels.messages import ArmState, Error
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.tables import Interface, SceneConfig

TORQUE_MARGIN = 1.001
"""Multiple of a torque limit beyond which a command is refused.

The servo level keeps the limits itself; the margin is for rounding.
"""


class BrakedArm(Plant, ABC):
    """An arm that refuses torques beyond the limits and reports its brakes. Implements `Link`.

    Its joints have drives and brakes, and its gripper is controlled by force.
    """

    is_simulated = False
    """True if each of several processes can have the arm, as a simulation of its own."""
    reports_torque = False
    """True if `torque` is the torque of the motors for the coming cycle after `follow`.

    Otherwise it is the predicted torque, and only the following error shows that a motor has
    failed.
    """
    exceeded: LimitViolation | None = None
    """Limit that the newest sample exceeds. None if it exceeds none or the link checks none."""

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
        super().__init__(cell)
        self.every = every  # ticks of a cycle
        # Ticks without a command after which the brakes must engage.
        self.patience = cell.patience.ticks(every, clock_ns * 1e-9)
        self.waited = self.patience
        self.torque: Array = np.zeros(len(cell.qpos))  # (joints,), N m: last torque of the motors
        self.grip_force = 0.0  # N: last force of the gripper
        self.state = DriveState.DISABLED  # of the drives, after the last `step`
        # Reason (see `Alarm.BRAKES_CLOSED`) and first tick of braking. None while released.
        self._brakes: tuple[int, int] | None = (BRAKED_AT_START, self.tick)
        # For the level that drives the arm, and for an arm that senses exactly.
        self.dynamics = Dynamics(cell)
        self._permitted = TORQUE_MARGIN * cell.bounds.torque

    @abstractmethod
    def sense(self) -> Sensed:
        """Return the newest sample; see `Link.sense`."""

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

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Release the brakes and apply torques in N m and a grip force in N; see `Link.drive`.

        Implementations set `waited` to 0. The base class does not implement it; see
        `has_interface`.
        """
        raise NotImplementedError

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        """Release the brakes and follow a set point; see `Link.follow`.

        Implementations set `waited` to 0, and `torque` to the predicted or reported torque. The
        base class does not implement it; see `has_interface`.
        """
        raise NotImplementedError

    @classmethod
    def has_interface(cls, interface: Interface) -> bool:
        """Return True if the drives accept commands of type `interface`.

        `rack check` refuses a config that names another type. By default, drives accept torques if
        the class implements `drive`, and set points if it implements `follow`.
        """
        if interface == "torque":
            return cls.drive is not BrakedArm.drive
        return cls.follow is not BrakedArm.follow

    def enable(self) -> None:
        """Request that the drives be enabled, without blocking.

        `state` becomes ENABLED in a later `step`. While the arm is not enabled, it is braked in
        every cycle. The default suits drives without states, which are enabled at once.
        """
        self.state = DriveState.ENABLED

    def disable(self) -> None:
        """Request that the drives be disabled. By default the brakes engage at once."""
        self.brake()
        self.state = DriveState.DISABLED

    def reset(self) -> None:
        """Request that drives in FAULT change to DISABLED, and clear `fault`.

        The default does nothing, which suits drives that report no faults.
        """

    def refused(self, torque: Array) -> Finding | None:
        """Return a finding if a torque must not be applied, or None if it may be applied.

        A torque that is NaN, infinite or beyond a limit is refused. This method counts and reports
        the refusal; the caller has to engage the brakes. `torque` is (joints,), N m.
        """
        if np.count_nonzero(np.abs(torque) <= self._permitted) == torque.size:
            return None
        if np.isfinite(torque).all():
            joint = int((np.abs(torque) / self._permitted).argmax())
            return self.refuse_command(Finding(Alarm.COMMAND_LIMIT, joint, float(torque[joint])))
        return self.refuse_command(
            Finding(Alarm.COMMAND_INVALID, int((~np.isfinite(torque)).argmax()))
        )

    def report_braking(self) -> None:
        """Report a finding if the arm has engaged its brakes by itself since the last cycle."""
        if self._brakes is None and self.braked:
            if self.state is not DriveState.ENABLED:
                self._report_brakes(Error.DRIVES, self.tick)
            else:
                since = self.tick - max(self.waited - self.patience, 1)
                self._report_brakes(BRAKED_WITHOUT_TORQUE, since, self.waited - self.every)

    def report_cycle(self) -> None:
        """Report an engagement or release of the brakes, with the reason."""
        super().report_cycle()
        why = self.brake_cause
        self.brake_cause = Error.NONE
        if self.braked:
            if self._brakes is None:
                self._report_brakes(why, self.tick)
        elif self._brakes is not None:
            why, since = self._brakes
            self._brakes = None
            if self.tick > since:
                self.findings.append(Finding(Alarm.BRAKES_OPENED, why, self.tick - since))

    def _report_brakes(self, why: int, since: int, missed: int = 0) -> None:
        """Report that the brakes engaged at tick `since`, with a command `missed` ticks overdue."""
        self._brakes = why, since
        self.findings.append(Finding(Alarm.BRAKES_CLOSED, why, missed, since))

    def restore(self, state: ArmState) -> None:
        """Continue from an `ArmState`.

        By default, drives that were disabled stay disabled, and all other drives are enabled.
        """
        super().restore(state)
        was_disabled = state.error == Error.DISABLED
        self.state = DriveState.DISABLED if was_disabled else DriveState.ENABLED
        self._brakes = (BRAKED_WITHOUT_TORQUE, self.tick) if self.braked else None

    @property
    def is_holding_object(self) -> bool:
        """True if the gripper touches an object. By default False."""
        return False

    @property
    def is_touching_surroundings(self) -> bool:
        """True if the arm, or its load, touches anything else. By default False."""
        return False

    def describe_contact(self, contact: tuple[int, int]) -> str:
        """Describe a `contact` as text. By default the text gives the numbers of the geoms."""
        return f"geom {contact[0]} touches geom {contact[1]}"

    def weaken(self, most: Array | None) -> None:
        """Limit the motor torques, to simulate weak motors.

        Injected faults of motors call this method. The default does nothing, so these faults have
        no effect. `most` is the largest torque of each joint, (joints,), N m, or None for intact
        motors.
        """

    def sense_wrist(self) -> Array | None:
        """Return the newest force in N and torque in N m at the wrist, (6,), in the sensor's frame.

        Return None, which is the default, if the arm has no wrist sensor.
        """
        return None
