"""A program of motion requests, in `[task]`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from rack.levels.level import Misfits, Program
from rack.levels.tables import (
    Finite,
    NotNegative,
    Positive,
    RobotConfig,
    SceneConfig,
    Table,
    Vector,
)

MAX_REQUESTS = 200

Turn = tuple[Finite, Finite, Finite, Finite]


class MotionStep(Table):
    """Base of the steps that move the arm."""

    segment: NotNegative = 0.0
    """time of the segment, s; 0: from the limits; too short: stretched"""
    acceleration: NotNegative = 0.0
    """half the time of the blend into it, s; 0: the level's default"""


class HomeStep(MotionStep):
    """Move the joints to where the arm starts."""

    do: Literal["home"] = "home"
    """the kind of step"""


class MoveStep(MotionStep):
    """Move straight in joint space, to joint positions or to where the tool has a pose."""

    do: Literal["move"] = "move"
    """the kind of step"""
    joints: tuple[Finite, ...] | None = None
    """joint positions, rad"""
    position: Vector | None = None
    """of the tool, m"""
    quaternion: Turn | None = None
    """of the tool, as w, x, y, z; as at home when not given"""

    @model_validator(mode="after")
    def _one_goal(self) -> MoveStep:
        if (self.position is None) == (self.joints is None):
            raise ValueError("a move has either position or joints")
        if self.quaternion is not None and (self.position is None or not any(self.quaternion)):
            raise ValueError("a quaternion belongs to a position, and is not all zero")
        return self


class LineStep(MotionStep):
    """Move the tool along a straight line, to a pose in the world or in the frame of a body, which
    it may follow."""

    do: Literal["line"] = "line"
    """the kind of step"""
    position: Vector
    """of the tool, m, in the frame of `body`"""
    quaternion: Turn | None = None
    """of the tool, as w, x, y, z, in that frame; as at home by default"""
    body: str | None = None
    """object or obstacle in whose frame the goal is; the world when not given"""
    live: bool = False
    """true: the goal follows the body; false: it is copied when the motion begins"""

    @model_validator(mode="after")
    def _follows_a_body(self) -> LineStep:
        if self.live and self.body is None:
            raise ValueError("a live goal needs a body that it follows")
        if self.quaternion is not None and not any(self.quaternion):
            raise ValueError("quaternion is all zero; its length must not be zero")
        return self


class StayStep(Table):
    """Stay at the goal before it; if that is live, follow it."""

    do: Literal["stay"] = "stay"
    """the kind of step"""
    seconds: Positive
    """for how long, s"""


class GripStep(Table):
    """Bring the gripper to an opening, at rest."""

    do: Literal["grip"] = "grip"
    """the kind of step"""
    opening: Finite
    """gripper joint position, m or rad"""
    force: Positive | None = None
    """largest force, N or N m; that of the gripper when not given"""
    seconds: NotNegative = 0.0
    """time that it takes, s; 0: the level's default"""


class CancelStep(Table):
    """Cancel what is under way or queued; the arm ramps to rest."""

    do: Literal["cancel"] = "cancel"
    """the kind of step"""
    after: NotNegative
    """time after the step before it began, s"""


Step = MoveStep | LineStep | HomeStep | StayStep | GripStep | CancelStep


class MotionProgram(Program):
    """Steps in their order: step k becomes request k + 1."""

    step: tuple[Annotated[Step, Field(discriminator="do")], ...] = Field(
        (), max_length=MAX_REQUESTS
    )
    """steps, done in their order"""

    def misfits(self, robot: RobotConfig | None, scene: SceneConfig) -> Misfits:
        """Yield key, value and reason of everything that the arm or the scene lacks."""
        if robot is None:
            return
        for k, step in enumerate(self.step):
            if (
                isinstance(step, MoveStep)
                and step.joints is not None
                and len(step.joints) != len(robot.joints)
            ):
                why = f"{len(step.joints)} values; permitted: {len(robot.joints)}, one per joint"
                yield f"step[{k}].joints", list(step.joints), why
            if isinstance(step, LineStep) and step.body not in (None, *scene.bodies):
                why = f"not in the scene; bodies: {', '.join(scene.bodies) or 'none'}"
                yield f"step[{k}].body", step.body, why
            if isinstance(step, GripStep) and robot.gripper is None:
                yield f"step[{k}].do", step.do, "the robot has no gripper"
