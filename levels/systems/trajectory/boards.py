"""Whether all boards that servo joints follow set points: motion continues only while they do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rack.levels.algebra import Array
from rack.levels.level import Reading
from rack.levels.systems.joint_boards.messages import JointStatus

HANDOVER_CYCLES = 4
"""Cycles from the first set point until the boards' statuses must show that they follow."""
MAX_SILENT_CYCLES = 3
"""Consecutive cycles without a new status after which a board is silent."""
MAX_REST_RAD_S = 1e-3
"""A joint whose set point is slower than this rests."""


class JointBoards:
    """Decides from the boards' statuses whether they are in step with this level, all or none.

    One that is lost, stopped or left alone lets all fall out of step: none gets set points, so each
    ramps to rest by itself. They get back into step when all hold at rest; motion continues from
    there.
    """

    def __init__(
        self, joints: Sequence[str], ranges: Array, handover: int = HANDOVER_CYCLES
    ) -> None:
        """Await the joints' answer to the first set point for `handover` cycles. `ranges`,
        (joints, 2), rad: where joints can be.
        """
        self._joints = joints
        self._low, self._high = ranges.T
        self._handover = handover
        self.in_step = False
        self.position = np.zeros(len(joints))  # (joints,), rad: where the boards hold the joints
        self._cycles = 0  # since they got into step
        self._silent: dict[str, int] = {}  # consecutive cycles without a new status, by board
        self.awaited = "no board servoes a joint"  # what a level out of step waits for

    def update(self, statuses: Mapping[str, Reading[JointStatus]]) -> bool:
        """Read all statuses; return True in the cycle in which the boards get into step."""
        self._cycles += 1
        for board, reading in statuses.items():
            heard = reading.is_new and not reading.is_lost
            self._silent[board] = 0 if heard else self._silent.get(board, 0) + 1
        if why := self._kept(statuses):
            self.leave(f"waiting for {why}")
            return False
        if self.in_step or not self._hold(statuses):
            return False
        self.in_step = True
        self._cycles = 0
        return True

    def leave(self, why: str) -> None:
        """Let all fall out of step: they come to rest by themselves, and motion begins again from
        where they hold.
        """
        self.in_step = False
        self.awaited = why

    def _kept(self, statuses: Mapping[str, Reading[JointStatus]]) -> str:
        """Return the board that does not follow, and why; empty: all do, or could."""
        for board, reading in statuses.items():
            status = reading.message
            silent = self._silent[board]
            if silent > MAX_SILENT_CYCLES or not reading.is_there:
                return f"{board}: no status for {silent} cycles"
            if status.stopped:
                return f"{board}: {status.reason or 'it does not follow set points'}"
            if self.in_step and status.holding and self._cycles > self._handover:
                return f"{board}: it holds"
        return ""

    def _hold(self, statuses: Mapping[str, Reading[JointStatus]]) -> bool:
        """Return whether all boards hold all joints at rest; take over where."""
        driven = np.zeros(len(self._joints), dtype=bool)
        for board, reading in statuses.items():
            status = reading.message
            mine = status.driven.astype(bool)
            # Written so that NaN does not count as rest, nor as a place.
            resting = (np.abs(status.target_velocity[mine]) <= MAX_REST_RAD_S).all()
            if self._silent[board] or not (status.holding and resting):
                self.awaited = f"waiting for {board}: it does not hold its joints at rest"
                return False
            inside = (self._low <= status.target) & (status.target <= self._high)
            if (astray := mine & ~inside).any():
                joint = int(astray.argmax())
                place = f"'{self._joints[joint]}' at {status.target[joint]:.3g} rad"
                self.awaited = f"waiting for {board}: it holds {place}, out of its range"
                return False
            self.position[mine] = status.target[mine]
            driven |= mine
        if not driven.all():
            self.awaited = f"no board servoes joint '{self._joints[int(driven.argmin())]}'"
        return bool(driven.all())
