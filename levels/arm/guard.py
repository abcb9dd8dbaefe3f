"""What an arm that does not keep its limits by itself is driven through: its samples are judged,
and torques cut by them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array
from rack.levels.arm.arm import Arm, Sensed
from rack.levels.arm.drives import LimitGate
from rack.levels.level import Finding
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.limits import Bounds


class Exceeded(NamedTuple):
    """A limit that a joint is beyond: what found it, and in words."""

    finding: Finding
    text: str


class GuardedArm:
    """Implements `Link` around an arm, by its samples alone.

    A torque that is not finite, or beyond its limit, is refused and engages the brakes. Others are
    cut so that the cycle ends within the limits, at a state from which the arm can still be stopped
    (`LimitGate`). The largest error that the encoders may have is kept as a margin on each limit;
    a sample beyond a limit by more than that error is a violation, is counted, and shows in
    `exceeded`. What only a simulation knows, contacts and the truth, is not judged here.
    """

    def __init__(self, arm: Arm, cell: Cell, joints: Sequence[str], cycle_s: float) -> None:
        """Guard an arm with these `joints` that gets a torque every `cycle_s`."""
        self._arm = arm
        bounds = cell.bounds
        off = cell.encoders.off
        speed_off = cell.encoders.speed_off
        self._low = bounds.position[:, 0] - off
        self._high = bounds.position[:, 1] + off
        self._fastest = bounds.velocity + speed_off
        self._joints = joints
        kept = Bounds(
            position=bounds.position + np.stack((off, -off), axis=1),
            velocity=np.maximum(bounds.velocity - speed_off, speed_off),
            torque=bounds.torque,
        )
        self._gate = LimitGate(kept, cell.limits.acceleration, cycle_s, Dynamics(cell))
        self._sample: Sensed | None = None
        self.exceeded: Exceeded | None = None
        """Of the newest sample."""

    def sense(self) -> Sensed:
        """Return the newest sample, judged."""
        sample = self._arm.sense()
        is_new = self._sample is None or sample.tick != self._sample.tick
        self._sample = sample
        if is_new:
            self._judge(sample)
        return sample

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Pass on the torque, (joints,), N m, cut to what the limits permit; see `Link.drive`."""
        arm = self._arm
        if (refused := arm.refused(torque)) is not None:
            arm.clipped += 1
            arm.brake()
            return refused
        if (sample := self._sample) is not None and np.isfinite(sample[:2]).all():
            torque, cut = self._gate.admit(torque, sample.position, sample.velocity)
            arm.clipped += cut
        return arm.drive(torque, grip_force)

    def _judge(self, sample: Sensed) -> None:
        # What is not finite is the sensors' fault, and found as that.
        q = sample.position
        speed = np.abs(sample.velocity)
        far = (q < self._low) | (q > self._high)
        fast = speed > self._fastest
        if not (far.any() or fast.any()):
            self.exceeded = None
            return
        joint = int((far | fast).argmax())
        if far[joint]:
            value = float(q[joint])
            permitted = f"{self._low[joint]:g} to {self._high[joint]:g} rad"
            what = f"position {value:.4g} rad"
        else:
            value = float(sample.velocity[joint])
            permitted = f"up to {self._fastest[joint]:g} rad/s"
            what = f"velocity {value:.4g} rad/s"
        text = f"{what} of joint '{self._joints[joint]}' as sensed; permitted: {permitted}"
        arm = self._arm
        arm.violations += 1
        arm.first_violation = arm.first_violation or f"{text}, at tick {sample.tick}"
        self.exceeded = Exceeded(Finding(Alarm.LIMIT_EXCEEDED, joint, value), text)
