"""Supervision of the boards that servo joints: motion continues only while all of them follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rack.levels.algebra import Array
from rack.levels.level import Reading
from rack.levels.systems.joint_boards.messages import JointStatus

HANDOVER_CYCLES = 4
"""Cycles after the first set point within which the boards' statuses must show that they follow."""
MAX_SILENT_CYCLES = 3
"""Number of consecutive cycles that a board may spend without a new status."""
MAX_REST_RAD_S = 1e-3
"""A joint is at rest while its set point is slower than this."""


class JointBoards:
    """Decides whether the boards that servo joints are in step with this level.

    The boards are in step while all of them follow this level's set points. If one board is lost,
    stopped or holds by itself, all fall out of step: none gets set points, and each ramps its
    joints to rest. They return to step when all of them hold their joints at rest. Motion then
    continues from the positions at which the joints are held.

    Attributes:
        in_step: Whether the boards follow this level's set points.
        position: Joint positions at which the boards hold the joints, (joints,), rad.
        wait_reason: Why the level waits while the boards are out of step.
    """

    def __init__(
        self, joints: Sequence[str], ranges: Array, handover: int = HANDOVER_CYCLES
    ) -> None:
        """Start out of step.

        Args:
            joints: Names of all joints.
            ranges: Lower and upper position limit of each joint, (joints, 2), rad.
            handover: Cycles after the first set point until the boards must follow.
        """
        self._joints = joints
        self._low, self._high = ranges.T
        self._handover = handover
        self.in_step = False
        self.position = np.zeros(len(joints))  # (joints,), rad
        self._cycles_in_step = 0  # since the boards came into step
        self._silent_cycles: dict[
            str, int
        ] = {}  # consecutive cycles without a new status, by board
        self.wait_reason = "no board servoes a joint"

    def update(self, statuses: Mapping[str, Reading[JointStatus]]) -> bool:
        """Update `in_step` from the statuses. Returns True if it changes to True."""
        self._cycles_in_step += 1
        for board, reading in statuses.items():
            has_status = reading.is_new and not reading.is_lost
            self._silent_cycles[board] = 0 if has_status else self._silent_cycles.get(board, 0) + 1
        if reason := self._find_board_not_following(statuses):
            self.leave_step(f"waiting for {reason}")
            return False
        if self.in_step or not self._take_over_hold_positions(statuses):
            return False
        self.in_step = True
        self._cycles_in_step = 0
        return True

    def leave_step(self, reason: str) -> None:
        """Mark the boards as out of step, and set `wait_reason` to `reason`.

        The boards then bring the joints to rest, and motion later continues from those positions.
        """
        self.in_step = False
        self.wait_reason = reason

    def _find_board_not_following(self, statuses: Mapping[str, Reading[JointStatus]]) -> str:
        """Return the name of a board that does not follow and why. Empty if all boards follow."""
        for board, reading in statuses.items():
            status = reading.message
            silent_cycles = self._silent_cycles[board]
            if silent_cycles > MAX_SILENT_CYCLES or not reading.has_message:
                return f"{board}: no status for {silent_cycles} cycles"
            if status.stopped:
                return f"{board}: {status.reason or 'it does not follow set points'}"
            if self.in_step and status.holding and self._cycles_in_step > self._handover:
                return f"{board}: it holds"
        return ""

    def _take_over_hold_positions(self, statuses: Mapping[str, Reading[JointStatus]]) -> bool:
        """Copy the joint positions at which the boards hold the joints to `position`.

        Returns:
            True if the boards hold all joints at rest. Otherwise `wait_reason` is set.
        """
        is_driven = np.zeros(len(self._joints), dtype=bool)
        for board, reading in statuses.items():
            status = reading.message
            own_joints = status.driven.astype(bool)
            # Both comparisons are written such that NaN is neither at rest nor in range.
            are_resting = (np.abs(status.target_velocity[own_joints]) <= MAX_REST_RAD_S).all()
            if self._silent_cycles[board] or not (status.holding and are_resting):
                self.wait_reason = f"waiting for {board}: it does not hold its joints at rest"
                return False
            is_in_range = (self._low <= status.target) & (status.target <= self._high)
            if (is_outside := own_joints & ~is_in_range).any():
                joint = int(is_outside.argmax())
                place = f"'{self._joints[joint]}' at {status.target[joint]:.3g} rad"
                self.wait_reason = f"waiting for {board}: it holds {place}, out of its range"
                return False
            self.position[own_joints] = status.target[own_joints]
            is_driven |= own_joints
        if not is_driven.all():
            self.wait_reason = f"no board servoes joint '{self._joints[int(is_driven.argmin())]}'"
        return bool(is_driven.all())
