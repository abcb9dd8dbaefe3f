"""What planning takes for true: where bodies are and what is in the gripper, now or when the moves ahead are done."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rack.levels.messages import Verb
from rack.levels.planning.collision import CollisionChecker
from rack.levels.planning.move import Move
from rack.levels.planning.pose import Pose

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Situation:
    """Poses of the world model's rows, (bodies, 3) in m and (bodies, 4).

    `held` is the row in the gripper and `grip` its pose in the tool's frame; None: nothing is held.
    """

    positions: Array
    quaternions: Array
    held: int | None = None
    grip: Pose | None = None

    def object_pose(self, row: int) -> Pose:
        """Return where the world model has object `row`."""
        return Pose(self.positions[row], self.quaternions[row])

    def after(self, move: Move) -> Situation:
        """Return the situation that `move`, well done, leaves behind."""
        if move.verb is Verb.GRASP and move.object is not None:
            return self.holding(move.object, move.tool.inverse() @ self.object_pose(move.object))
        if move.verb is Verb.RELEASE and self.held is not None and self.grip is not None:
            return self.with_body(self.held, move.tool @ self.grip).holding(None, None)
        return self

    def holding(self, row: int | None, grip: Pose | None) -> Situation:
        """Return the same with object `row` in the gripper at `grip` in the tool's frame; None: with nothing."""
        return replace(self, held=row, grip=grip)

    def with_body(self, row: int, at: Pose) -> Situation:
        """Return the same with body `row` somewhere else."""
        positions, quaternions = self.positions.copy(), self.quaternions.copy()
        positions[row], quaternions[row] = at
        return replace(self, positions=positions, quaternions=quaternions)

    def lay_out(self, checker: CollisionChecker, touched: int | None) -> None:
        """Set `checker` to this situation, object `touched` free to touch supports and gripper."""
        checker.place(self.positions, self.quaternions)
        if self.held is None or self.grip is None:
            checker.hold(None)
        else:
            checker.hold(self.held, *self.grip)
        checker.permit(touched)
