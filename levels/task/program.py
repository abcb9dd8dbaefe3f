"""The task in a config: the `[task]` table, a program of actions, and the parameters of the level."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from rack.levels.errors import ProgramError
from rack.levels.robot import Finite, Positive, RobotConfig, Table
from rack.levels.scene import SceneConfig

Vector = tuple[Finite, Finite, Finite]

VERBS = ("transfer", "goto", "home")


class Action(Table):
    """Base of all actions."""

    by: Positive | None = Field(None, description="simulated time by which the action must be done, s")


class Transfer(Action):
    """Move an object to another place."""

    do: Literal["transfer"] = "transfer"
    object: str = Field(description="object of the scene")
    to: Vector = Field(description="where the object's origin goes, m")
    yaw: Finite | None = Field(None, description="turn of the object's x axis there, rad; free when not given")
    lift: Positive = Field(0.1, description="height of the straight motion above grasp and release, m")

    def __str__(self) -> str:
        return f"transfer {self.object} to {list(self.to)}"


class Goto(Action):
    """Move the tool to a pose, or the joints to positions."""

    do: Literal["goto"] = "goto"
    position: Vector | None = Field(None, description="of the tool, m")
    quaternion: tuple[Finite, Finite, Finite, Finite] | None = Field(None, description="of the tool, as w, x, y, z")
    direction: Vector | None = Field(None, description="of the tool's z axis, any turn about it; down when not given")
    joints: tuple[Finite, ...] | None = Field(None, description="joint positions, rad")

    @model_validator(mode="after")
    def _one_goal(self) -> Goto:
        if (self.position is None) == (self.joints is None):
            raise ValueError("a goto has either position or joints")
        if self.quaternion is not None and self.direction is not None:
            raise ValueError("a goto has either quaternion or direction, or neither")
        if self.joints is not None and (self.quaternion is not None or self.direction is not None):
            raise ValueError("a goto with joints has no quaternion and no direction")
        for name in ("quaternion", "direction"):
            if getattr(self, name) is not None and not any(getattr(self, name)):
                raise ValueError(f"{name} is all zero; its length must not be zero")
        return self

    def __str__(self) -> str:
        return f"goto {list(self.position)}" if self.position is not None else f"goto joints {list(self.joints or ())}"


class Home(Action):
    """Move the arm back to its start."""

    do: Literal["home"] = "home"

    def __str__(self) -> str:
        return "home"


class TaskConfig(Table):
    """A program: actions in their order."""

    action: tuple[Annotated[Transfer | Goto | Home, Field(discriminator="do")], ...] = Field(
        (), description="actions, done in their order"
    )


class TaskParams(Table):
    """Times that the levels below need at most, for the promise of a time, and how long they may make no progress.

    In `[board.<name>.params]`; s of simulated time.
    """

    beginning: Positive = Field(0.1, description="from a segment's arrival in the primitive level to motion, s")
    settling: Positive = Field(0.2, description="from the end of a motion to the report that it is done, s")
    gripping: Positive = Field(0.6, description="time that the gripper takes to open or close and to settle, s")
    stalled_s: Positive = Field(
        90.0,
        description="time without any progress after which the task ends, unless an operator holds it; longer than "
        "the patience of the level below, s",
    )


def read_program(table: Mapping[str, Any], robot: RobotConfig, scene: SceneConfig) -> TaskConfig:
    """Return the program in the `[task]` table.

    Raises `ProgramError` with one line per mistake: place, value and what is valid.
    """
    try:
        program = TaskConfig(**table)
    except ValidationError as error:
        raise ProgramError("\n".join(_line(mistake) for mistake in error.errors())) from error
    mistakes = [line for k, action in enumerate(program.action) for line in _misfits(k, action, robot, scene)]
    if mistakes:
        raise ProgramError("\n".join(mistakes))
    return program


def _line(mistake: Any) -> str:
    # pydantic adds the chosen kind of action to the place; the user did not write it there.
    path = [str(part) for k, part in enumerate(mistake["loc"]) if not (k == 2 and part in VERBS)]
    kind, value = mistake["type"], f" = {mistake['input']!r}"
    text = mistake["msg"].removeprefix("Value error, ")
    if kind.startswith("union_tag"):
        path.append("do")
        value = f" = {mistake['ctx']['tag']!r}" if "tag" in mistake.get("ctx", {}) else ""
        text = f"valid: {', '.join(VERBS)}"
    elif kind == "missing" or isinstance(mistake["input"], Mapping):
        value = ""
    return f"task.{'.'.join(path)}{value}: {text[:1].lower()}{text[1:]}"


def _misfits(k: int, action: Action, robot: RobotConfig, scene: SceneConfig) -> list[str]:
    """Return mistakes for what an action needs and robot or scene lack."""
    place, found = f"task.action.{k}", []
    if isinstance(action, Transfer):
        if action.object not in scene.objects:
            valid = ", ".join(scene.objects) or "none"
            found.append(f"{place}.object = '{action.object}': not in the scene; objects: {valid}")
        if robot.gripper is None:
            found.append(f"{place}.do = 'transfer': the robot has no gripper; valid: goto, home")
    if isinstance(action, Goto) and action.joints is not None and len(action.joints) != len(robot.joints):
        found.append(f"{place}.joints: {len(action.joints)} values; valid: {len(robot.joints)}, one per joint")
    return found
