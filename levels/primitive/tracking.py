"""Checks that the servo receives and follows set points; motion continues only while it does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rack.backplane.message import State
from rack.levels.level import Reading
from rack.levels.messages import DrivenArm, Error
from rack.levels.primitive.motion_segment import SegmentFault

LEAD_CYCLES = 2
"""Cycles from the release that computes a set point to the tick at which it is due.

The set point becomes visible to the servo after one cycle. The servo then interpolates to it over a
second cycle."""
SEEN_CYCLES = 2
"""Cycles by which the world model lags behind the servo."""
HANDOVER_CYCLES = 4
"""Cycles from the first set point until the status of the servo must show that it follows."""
MAX_MISSED_STATUSES = 3
"""Consecutive cycles without a new status after which the servo counts as silent."""
MAX_REST_RAD_S = 1e-3
"""A joint whose interpolated set point is slower than this counts as at rest."""
MAX_UNEXPLAINED_CYCLES = 50
"""Cycles after which a wait is reported with its reason. Short ones are normal after a restart."""


class Tracking:
    """Decides from the status of the servo whether it is in step, that is, follows the set points.

    The servo falls out of step when either level restarts, when it has missed so many set points
    that it holds the arm, or when it is stopped. It gets back into step when it holds the arm at
    rest and is not stopped. Motion then continues from the position at which the arm is held.

    Attributes:
        in_step: True if the servo follows set points.
        silent_cycles: Number of consecutive cycles without a new status.
    """

    def __init__(self) -> None:
        self.in_step = False
        self.silent_cycles = 0
        self._cycles_in_step = 0
        self._unexplained_cycles = 0

    def update_status(self, status: Reading[DrivenArm]) -> bool:
        """Process one status. Return True in the cycle in which the servo gets back into step."""
        heard = status.is_new and not status.is_lost
        self.silent_cycles = 0 if heard else self.silent_cycles + 1
        self._cycles_in_step += 1
        servo = status.message
        left_alone = servo.holding and self._cycles_in_step > HANDOVER_CYCLES
        if self.silent_cycles > MAX_MISSED_STATUSES or left_alone or servo.stopped:
            self.in_step = False
        self._unexplained_cycles = (
            0 if self.in_step or servo.stopped else self._unexplained_cycles + 1
        )
        if self.in_step or not heard or not servo.holding or servo.stopped:
            return False
        # The comparison is written so that NaN does not count as rest.
        if (
            not np.abs(servo.target_velocity).max() <= MAX_REST_RAD_S
            or not np.isfinite(servo.target).all()
        ):
            return False
        self.in_step = True
        self._cycles_in_step = 0
        return True

    def describe_wait(self, servo: DrivenArm) -> str:
        """Describe what a level waits for while the servo does not follow its set points."""
        if self.silent_cycles > MAX_MISSED_STATUSES:
            return f"waiting for servo: no status for {self.silent_cycles} cycles"
        if servo.state == State.HOLDING and servo.reason:
            return f"waiting for servo: {servo.reason}"
        if servo.standing:
            return "waiting for servo: held by the operator until `resume`"
        if servo.braked:
            return "waiting for servo: brakes engaged"
        if self._unexplained_cycles > MAX_UNEXPLAINED_CYCLES:
            return "waiting for servo: it does not report `holding` with a target at rest"
        return "waiting for servo: it does not follow set points"


class DeviationMonitor:
    """Counts cycles in which a joint is too far from its set point.

    A few consecutive cycles are permitted; during them, motion must hold.

    Attributes:
        description: Text with the joint and its distance. Empty if no joint is too far away.
        fault: Set when a joint has been too far away for too long, else None.
    """

    def __init__(self, joints: Sequence[str], permitted_rad: float, permitted_cycles: int) -> None:
        """Permit larger distances than `permitted_rad` for at most `permitted_cycles` cycles.

        Args:
            joints: Names of the joints.
            permitted_rad: Distance up to which a cycle does not count.
            permitted_cycles: Number of consecutive cycles with a larger distance that are
                tolerated.
        """
        self._joints = joints
        self._permitted_rad = permitted_rad
        self._permitted_cycles = permitted_cycles
        self._cycles = 0
        self.description = ""
        self.fault: SegmentFault | None = None

    def reset_count(self) -> None:
        """Reset the count, and clear `description` and `fault`."""
        self._cycles = 0
        self.description = ""
        self.fault = None

    def update_status(self, servo: DrivenArm) -> None:
        """Process one status. Sets `fault` when a joint has been too far away for too long."""
        errors = np.abs(servo.position - servo.target)
        if errors.max() <= self._permitted_rad:
            self.reset_count()
            return
        self._cycles += 1
        joint = int(errors.argmax())
        self.description = (
            f"joint '{self._joints[joint]}' is {errors[joint]:.4f} rad from its set point"
        )
        if self._cycles > self._permitted_cycles:
            self.fault = SegmentFault(
                Error.FOLLOWING, f"{self.description}; valid: at most {self._permitted_rad} rad"
            )
