"""The layer next to an arm: positions of the joints, from what its drives give."""

from rack.levels.algebra import Array
from rack.levels.arm.arm import Arm, JointTarget, Sensed
from rack.levels.level import Finding


class CalibratedLink:
    """Implements `Link` around an arm whose samples are off by `robot.calibration.offset`."""

    def __init__(self, arm: Arm, offset: Array) -> None:
        """Add `offset`, (joints,), rad, to positions."""
        self._arm = arm
        self._offset = offset

    def sense(self) -> Sensed:
        """Return the newest sample, calibrated."""
        sample = self._arm.sense()
        return sample._replace(position=sample.position + self._offset)

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Pass on the torque; see `Link.drive`."""
        return self._arm.drive(torque, grip_force)

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        """Pass on the set points, as the drives count positions; see `Link.follow`."""
        target = target._replace(position=target.position - self._offset)
        return self._arm.follow(target, grip_force)
