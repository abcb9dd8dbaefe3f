"""An elemental move as planning sees it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rack.levels.messages import Verb
from rack.levels.planning.pose import Pose, pose

Array = NDArray[np.float64]

NAMES = {
    Verb.NONE: "rest",
    Verb.MOVE: "move",
    Verb.MOVE_JOINTS: "move",
    Verb.APPROACH: "approach",
    Verb.GRASP: "grasp",
    Verb.DEPART: "depart",
    Verb.RELEASE: "release",
}


class Move(NamedTuple):
    """One `ELEMENTAL_MOVE`. `tool` is the tool's pose at its end, `joints` (joints,) in rad, `by_s` 0 for no such time.

    `posture`: of the configurations at `tool`, the one nearest to `joints` is wanted. `object` is a row, None for none.
    """

    id: int
    action: int
    verb: Verb
    object: int | None
    tool: Pose
    joints: Array
    posture: bool
    by_s: float

    @property
    def is_motion(self) -> bool:
        """True when the arm moves and a path is needed; False for the gripper."""
        return self.verb not in (Verb.GRASP, Verb.RELEASE)

    @property
    def touches(self) -> bool:
        """True when what is held, or is about to be grasped, may touch its support."""
        return self.verb in (Verb.APPROACH, Verb.DEPART)

    def write_to(self, record: Any) -> None:
        """Fill one element of an array of `ELEMENTAL_MOVE`."""
        record["id"], record["action"], record["verb"] = self.id, self.action, self.verb
        record["object"] = -1 if self.object is None else self.object
        record["position"], record["quaternion"] = self.tool
        record["joints"], record["posture"], record["by"] = self.joints, self.posture, self.by_s


def read_move(record: Any) -> Move:
    """Return the move that one element of an array of `ELEMENTAL_MOVE` holds, in arrays of its own."""
    row = int(record["object"])
    return Move(
        id=int(record["id"]),
        action=int(record["action"]),
        verb=Verb(int(record["verb"])),
        object=None if row < 0 else row,
        tool=pose(record["position"], record["quaternion"]),
        joints=np.array(record["joints"]),
        posture=bool(record["posture"]),
        by_s=float(record["by"]),
    )


def read_window(command: Any) -> list[Move]:
    """Return the moves of a `TASK_COMMAND` or a `TASK_PLAN`, oldest first."""
    return [read_move(record) for record in command.moves[: command.count]]
