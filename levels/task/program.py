"""The task in a config: the `[task]` table with its program, and the parameters of the level."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, model_validator

from rack.levels.level import Mismatches, Program
from rack.levels.tables import (
    Finite,
    GoalConfig,
    Positive,
    Quaternion,
    RobotConfig,
    SceneConfig,
    Table,
    Vector,
)

ROUNDING_S = 1e-9
"""Tolerance of comparisons with deadlines in s, as ticks times the clock's period are rounded."""
DOWN = (0.0, 0.0, -1.0)
"""Default direction of the tool's z axis."""


class Action(Table):
    """Base class of all actions."""

    by: Positive | None = None
    """simulated time by which the action must be done [s]"""


class Transfer(Action):
    """Move an object to another place."""

    do: Literal["transfer"] = "transfer"
    """the kind of action"""
    object: str
    """object of the scene"""
    to: Vector
    """final position of the object's origin [m]"""
    yaw: Finite | None = None
    """final angle of the object's x axis [rad]; free if not given"""
    lift: Positive = 0.1
    """height of the straight motion above grasp and release [m]"""

    def __str__(self) -> str:
        return f"transfer {self.object} to {list(self.to)}"


class Goto(Action):
    """Move the tool to a pose, or the joints to positions."""

    do: Literal["goto"] = "goto"
    """the kind of action"""
    position: Vector | None = None
    """of the tool [m]"""
    quaternion: Quaternion | None = None
    """of the tool, as w, x, y, z"""
    direction: Vector | Literal["any"] | None = None
    """of the tool's z axis, with any turn about it; default: down; with 'any' the orientation is
    free, as an arm with fewer than six joints reaches most places in few orientations"""
    joints: tuple[Finite, ...] | None = None
    """joint positions [rad]"""

    @model_validator(mode="after")
    def _check_goal(self) -> Goto:
        """Check that there is exactly one goal, and that no quaternion or direction is zero."""
        if (self.position is None) == (self.joints is None):
            raise ValueError("a goto has either position or joints")
        if self.quaternion is not None and self.direction is not None:
            raise ValueError("a goto has either quaternion or direction, or neither")
        if self.joints is not None and (self.quaternion is not None or self.direction is not None):
            raise ValueError("a goto with joints has no quaternion and no direction")
        for name in ("quaternion", "direction"):
            if getattr(self, name) not in (None, "any") and not any(getattr(self, name)):
                raise ValueError(f"{name} is zero; its length must not be zero")
        return self

    def __str__(self) -> str:
        if self.position is not None:
            return f"goto {list(self.position)}"
        return f"goto joints {list(self.joints or ())}"


class Home(Action):
    """Move the arm back to its home position."""

    do: Literal["home"] = "home"
    """the kind of action"""

    def __str__(self) -> str:
        return "home"


AnyAction = Annotated[Transfer | Goto | Home, Field(discriminator="do")]


class TaskConfig(Program):
    """A program of actions, done in their order."""

    action: tuple[AnyAction, ...] = ()
    """actions, done in their order"""

    def list_goals(self) -> Iterator[GoalConfig]:
        """Yield the final positions of all transferred objects."""
        for action in self.action:
            if isinstance(action, Transfer):
                yield GoalConfig(object=action.object, position=action.to)

    def find_mismatches(self, robot: RobotConfig | None, scene: SceneConfig) -> Mismatches:
        """Yield key, value and reason of each entry that is inconsistent with arm or scene."""
        if robot is None:
            return
        for k, action in enumerate(self.action):
            for key, value, why in find_mismatches(action, robot, scene):
                yield f"action[{k}].{key}", value, why


class TaskParams(Table):
    """Time limits of the task level.

    Except for `stalled_s` they are the longest times that the levels below need, from which finish
    times are computed. In `[board.<name>.params]`; s of simulated time.
    """

    beginning: Positive = 0.1
    """longest time from a segment's arrival at the primitive level to motion [s]"""
    settling: Positive = 0.2
    """longest time from the end of a motion to the report that it is done [s]"""
    gripping: Positive = 0.6
    """longest time for the gripper to open or close and to settle [s]"""
    stalled_s: Positive = 90.0
    """time without any progress after which the task ends, unless an operator holds it; longer than
    the patience of the level below [s]"""


read_program = TaskConfig.read


def find_mismatches(action: Action, robot: RobotConfig, scene: SceneConfig) -> Mismatches:
    """Yield key, value and reason of each entry of an action that conflicts with arm or scene.

    Args:
        action: The action.
        robot: The `[robot]` table.
        scene: The `[scene]` table.
    """
    if isinstance(action, Transfer):
        if action.object not in scene.objects:
            yield (
                "object",
                action.object,
                f"not in the scene; objects: {', '.join(scene.objects) or 'none'}",
            )
        if robot.gripper is None:
            yield "do", action.do, "the robot has no gripper; valid actions: goto, home"
    if (
        isinstance(action, Goto)
        and action.joints is not None
        and len(action.joints) != len(robot.joints)
    ):
        why = f"has {len(action.joints)} values but needs {len(robot.joints)}, one per joint"
        yield "joints", list(action.joints), why
