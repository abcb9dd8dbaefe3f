"""Elemental moves for planning, and the situations before and after them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from rack.levels.algebra import Array
from rack.levels.messages import TaskCommand, Verb
from rack.levels.planning.collision import CollisionChecker
from rack.levels.planning.pose import Pose, make_pose

VERB_NAMES = {verb: verb.name.lower() for verb in Verb}
VERB_NAMES |= {Verb.NONE: "rest", Verb.MOVE_JOINTS: "move"}


class Move(NamedTuple):
    """One elemental move, read from an `ElementalMove` record."""

    id: int
    action: int
    verb: Verb
    object: int | None  # row in the world model
    tool: Pose  # pose of the tool at the end
    joints: Array  # (joints,), rad
    posture: bool  # the configuration must be the one nearest to `joints`
    by_s: float  # simulated time by which the move must be done, s, or 0

    @property
    def is_motion(self) -> bool:
        """True if the arm moves and needs a path. False if only the gripper moves."""
        return self.verb not in (Verb.GRASP, Verb.RELEASE)

    @property
    def can_touch(self) -> bool:
        """True if the object that is held or about to be grasped may touch its support."""
        return self.verb in (Verb.APPROACH, Verb.DEPART)

    def write_to(self, record: Any) -> None:
        """Write the move to one element of an array of `ElementalMove`."""
        record["id"] = self.id
        record["action"] = self.action
        record["verb"] = self.verb
        record["object"] = -1 if self.object is None else self.object
        record["position"], record["quaternion"] = self.tool
        record["joints"] = self.joints
        record["posture"] = self.posture
        record["by"] = self.by_s


def read_window(command: TaskCommand) -> list[Move]:
    """Return copies of the moves of a `TaskCommand`, oldest first."""
    return [
        Move(
            id=int(record["id"]),
            action=int(record["action"]),
            verb=Verb(int(record["verb"])),
            object=int(record["object"]) if record["object"] >= 0 else None,
            tool=make_pose(record["position"], record["quaternion"]),
            joints=np.array(record["joints"]),
            posture=bool(record["posture"]),
            by_s=float(record["by"]),
        )
        for record in command.moves[: command.count]
    ]


@dataclass(frozen=True)
class Situation:
    """Poses of the bodies, and the object in the gripper, at present or after future moves."""

    positions: Array  # (bodies, 3), m, by row of the world model
    quaternions: Array  # (bodies, 4), as w, x, y, z
    held: int | None = None  # row of the object in the gripper, or None
    grip: Pose | None = None  # pose of that object in the frame of the tool

    def object_pose(self, row: int) -> Pose:
        """Return the pose of object `row`."""
        return Pose(self.positions[row], self.quaternions[row])

    def predict_after(self, move: Move) -> Situation:
        """Return the situation after `move` has succeeded."""
        if move.verb is Verb.GRASP and move.object is not None:
            return self.with_object_held(
                move.object, move.tool.inverse() @ self.object_pose(move.object)
            )
        if move.verb is Verb.RELEASE and self.held is not None and self.grip is not None:
            return self.with_body_at(self.held, move.tool @ self.grip).with_object_held(None, None)
        return self

    def with_object_held(self, row: int | None, grip: Pose | None) -> Situation:
        """Return this situation with another object in the gripper.

        Args:
            row: Row of the object, or None for an empty gripper.
            grip: Pose of the object in the frame of the tool.
        """
        return replace(self, held=row, grip=grip)

    def with_body_at(self, row: int, pose: Pose) -> Situation:
        """Return this situation with body `row` at another pose."""
        positions = self.positions.copy()
        quaternions = self.quaternions.copy()
        positions[row], quaternions[row] = pose
        return replace(self, positions=positions, quaternions=quaternions)

    def apply_to(self, checker: CollisionChecker, touched: int | None) -> None:
        """Set `checker` to this situation. Object `touched` may touch supports and gripper."""
        checker.place_bodies(self.positions, self.quaternions)
        if self.held is None or self.grip is None:
            checker.hold_object(None)
        else:
            checker.hold_object(self.held, *self.grip)
        checker.permit_contact(touched)
