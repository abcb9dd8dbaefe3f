"""What every arm does for the servo level: it counts, refuses, and reports its brakes."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from rack.backplane.watch.alarms import AT_START, NO_TORQUE, Alarm
from rack.levels.algebra import Array
from rack.levels.arm.drivable import DrivableArm, DriveState, JointTarget, Sensed
from rack.levels.arm.plant import Plant
from rack.levels.level import Finding
from rack.levels.messages import ArmState, Error
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.tables import Interface, SceneConfig

TORQUE_MARGIN = 1.001
"""Multiple of a torque limit beyond which a command is refused: the servo level keeps the limits
itself."""


class BrakedArm(Plant, DrivableArm):
    """Refuses torques beyond the limits, and reports its brakes. Implements `Link`."""

    def __init__(
        self, cell: Cell, scene: SceneConfig, clock_ns: int, every: int = 1, seed: int = 0
    ) -> None:
        """Start braked at home. One tick is `clock_ns`, one torque cycle `every` ticks; `seed` is
        for random noise.
        """
        super().__init__(cell)
        self.every = every  # ticks of a cycle
        # Ticks without a command after which the brakes must engage.
        self.patience = cell.patience.ticks(every, clock_ns * 1e-9)
        self.waited = self.patience
        self.torque: Array = np.zeros(len(cell.qpos))  # (joints,), N m: given to the motors last
        self.grip_force = 0.0  # N: given to the gripper last
        self.state = DriveState.DISABLED  # of the drives, as of the last `step`
        # Reason (see `Alarm.BRAKES_CLOSED`) and first tick of braking. None while released.
        self._brakes: tuple[int, int] | None = (AT_START, self.tick)
        # Used by the level that drives the arm, and by an arm that senses exactly.
        self.dynamics = Dynamics(cell)
        self._permitted = TORQUE_MARGIN * cell.bounds.torque

    @abstractmethod
    def sense(self) -> Sensed:
        """Return the newest sample, see `Link.sense`."""

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Release the brakes and apply torques, N m, and grip force, N; see `Link.drive`. Sets
        `waited` to 0. Default: refused, see `takes`.
        """
        raise NotImplementedError

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        """Release the brakes and follow; see `Link.follow`. Sets `waited` to 0, and `torque` to
        what is predicted or reported. Default: refused, see `takes`.
        """
        raise NotImplementedError

    @classmethod
    def takes(cls, interface: Interface) -> bool:
        """Say whether the drives have an interface: `rack check` refuses a config that names
        another. Default: by the methods that the class has.
        """
        if interface == "torque":
            return cls.drive is not BrakedArm.drive
        return cls.follow is not BrakedArm.follow

    def enable(self) -> None:
        """Ask the drives for torque; does not block: `state` becomes ENABLED in a later `step`.

        Until then, and whenever the arm is not enabled, it is braked in every cycle. Default:
        drives that know no states are enabled at once.
        """
        self.state = DriveState.ENABLED

    def disable(self) -> None:
        """Ask the drives to give no torque any more. Default: the brakes do it, at once."""
        self.brake()
        self.state = DriveState.DISABLED

    def reset(self) -> None:
        """Ask drives in FAULT to leave it, for DISABLED, and clear `fault`, which says why they
        were in it. Default: they cannot.
        """

    def refused(self, torque: Array) -> Finding | None:
        """Return why `torque`, (joints,), N m, must not be applied: NaN, infinite, beyond a limit;
        None: it may. The caller then brakes; the refusal is counted and reported here.
        """
        if np.count_nonzero(np.abs(torque) <= self._permitted) == torque.size:
            return None
        if np.isfinite(torque).all():
            joint = int((np.abs(torque) / self._permitted).argmax())
            return self.refuse(Finding(Alarm.COMMAND_LIMIT, joint, float(torque[joint])))
        return self.refuse(Finding(Alarm.COMMAND_INVALID, int((~np.isfinite(torque)).argmax())))

    def report_waiting(self) -> None:
        """Add to the findings that the arm has engaged its brakes by itself, between two cycles."""
        if self._brakes is None and self.braked:
            if self.state is not DriveState.ENABLED:
                self._report_brakes(Error.DRIVES, self.tick)
            else:
                since = self.tick - max(self.waited - self.patience, 1)
                self._report_brakes(NO_TORQUE, since, self.waited - self.every)

    def report_cycle(self) -> None:
        """Add to the findings what a cycle did to the brakes, each time, however short; and why."""
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
        self._brakes = why, since
        self.findings.append(Finding(Alarm.BRAKES_CLOSED, why, missed, since))

    def restore(self, state: ArmState) -> None:
        """Continue from an `ARM_STATE`. Default: drives that know no states are as they were."""
        super().restore(state)
        was_disabled = state.error == Error.DISABLED
        self.state = DriveState.DISABLED if was_disabled else DriveState.ENABLED
        self._brakes = (NO_TORQUE, self.tick) if self.braked else None

    @property
    def holds(self) -> bool:
        """Whether the gripper touches a part. Default: False."""
        return False

    @property
    def leans(self) -> bool:
        """Whether the arm, or its load, touches anything else. Default: False."""
        return False

    def named(self, contact: tuple[int, int]) -> str:
        """Return a `contact` in words. Default: the numbers of the geoms."""
        return f"geom {contact[0]} touches geom {contact[1]}"

    def weaken(self, most: Array | None) -> None:
        """Limit the motors' torque to `most`, (joints,), N m, as if they were weak; None: they are
        sound.

        Injected faults of motors act through this. Default: they have no effect.
        """

    def feel(self) -> Array | None:
        """Return the newest sample of the wrist sensor, (6,), N, N m, in its frame. Default: None,
        it has none.
        """
        return None
