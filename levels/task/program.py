"""The task in a config: the `[task]` table, a program of actions, and the parameters of the
level.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, model_validator

from rack.levels.level import Misfits, Program
from rack.levels.tables import Finite, GoalConfig, Positive, RobotConfig, SceneConfig, Table, Vector

ROUNDING_S = 1e-9
"""Margin of times against deadlines: ticks times the clock's period are not exact."""
DOWN = (0.0, 0.0, -1.0)
"""Direction of the tool's z axis when none is given."""


class Action(Table):
    """Base of all actions."""

    by: Positive | None = None
    """simulated time by which the action must be done [s]"""


class Transfer(Action):
    """Move an object to another place."""

    do: Literal["transfer"] = "transfer"
    """the kind of action"""
    object: str
    """object of the scene"""
    to: Vector
    """where the object's origin goes [m]"""
    yaw: Finite | None = None
    """turn of the object's x axis there [rad]; free when not given"""
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
    quaternion: tuple[Finite, Finite, Finite, Finite] | None = None
    """of the tool, as w, x, y, z"""
    direction: Vector | Literal["any"] | None = None
    """of the tool's z axis, any turn about it; down when not given; 'any': an arm of five joints or
    fewer reaches most places in few orientations"""
    joints: tuple[Finite, ...] | None = None
    """joint positions [rad]"""

    @model_validator(mode="after")
    def _one_goal(self) -> Goto:
        if (self.position is None) == (self.joints is None):
            raise ValueError("a goto has either position or joints")
        if self.quaternion is not None and self.direction is not None:
            raise ValueError("a goto has either quaternion or direction, or neither")
        if self.joints is not None and (self.quaternion is not None or self.direction is not None):
            raise ValueError("a goto with joints has no quaternion and no direction")
        for name in ("quaternion", "direction"):
            if getattr(self, name) not in (None, "any") and not any(getattr(self, name)):
                raise ValueError(f"{name} is all zero; its length must not be zero")
        return self

    def __str__(self) -> str:
        if self.position is not None:
            return f"goto {list(self.position)}"
        return f"goto joints {list(self.joints or ())}"


class Home(Action):
    """Move the arm back to its start."""

    do: Literal["home"] = "home"
    """the kind of action"""

    def __str__(self) -> str:
        return "home"


AnyAction = Annotated[Transfer | Goto | Home, Field(discriminator="do")]


class TaskConfig(Program):
    """A program: actions in their order."""

    action: tuple[AnyAction, ...] = ()
    """actions, done in their order"""

    def goals(self) -> Iterator[GoalConfig]:
        """Yield where transfers take objects."""
        for action in self.action:
            if isinstance(action, Transfer):
                yield GoalConfig(object=action.object, position=action.to)

    def misfits(self, robot: RobotConfig | None, scene: SceneConfig) -> Misfits:
        """Yield key, value and reason of everything that the arm or the scene lacks."""
        if robot is None:
            return
        for k, action in enumerate(self.action):
            for key, value, why in misfits(action, robot, scene):
                yield f"action[{k}].{key}", value, why


class TaskParams(Table):
    """Times that the levels below need at most, for the promise of a time, and how long they may
    make no progress.

    In `[board.<name>.params]`; s of simulated time.
    """

    beginning: Positive = 0.1
    """from a segment's arrival in the primitive level to motion [s]"""
    settling: Positive = 0.2
    """from the end of a motion to the report that it is done [s]"""
    gripping: Positive = 0.6
    """time that the gripper takes to open or close and to settle [s]"""
    stalled_s: Positive = 90.0
    """time without any progress after which the task ends, unless an operator holds it; longer than
    the patience of the level below [s]"""


read_program = TaskConfig.read


def misfits(action: Action, robot: RobotConfig, scene: SceneConfig) -> Misfits:
    """Yield key, value and reason of everything that the arm or the scene lacks for an action."""
    if isinstance(action, Transfer):
        if action.object not in scene.objects:
            yield (
                "object",
                action.object,
                f"not in the scene; objects: {', '.join(scene.objects) or 'none'}",
            )
        if robot.gripper is None:
            yield "do", action.do, "the robot has no gripper; permitted: goto, home"
    if (
        isinstance(action, Goto)
        and action.joints is not None
        and len(action.joints) != len(robot.joints)
    ):
        why = f"{len(action.joints)} values; permitted: {len(robot.joints)}, one per joint"
        yield "joints", list(action.joints), why
