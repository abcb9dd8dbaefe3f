"""The program of a grasp in `[task]`: named postures of the fingers, and steps.

The steps begin and end with an open hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from rack.levels.level import Mismatches, Program
from rack.levels.tables import Finite, HandConfig, Positive, RobotConfig, SceneConfig, Table, Vector

MAX_STEPS = 100

Posture = Mapping[str, tuple[Finite, ...]]


class PreshapeStep(Table):
    """Move the joints to a posture."""

    do: Literal["preshape"] = "preshape"
    """the kind of step"""
    posture: str
    """name of the posture, in `[task.posture]`"""
    seconds: Positive = 1.0
    """duration [s]"""


class CloseStep(Table):
    """Move the tips at constant speed towards points in an object until each touches it.

    A tip that reaches its point has missed the object. Without points, a plan from the level above
    defines fingers and points.
    """

    do: Literal["close"] = "close"
    """the kind of step"""
    object: str
    """object of the scene"""
    points: Mapping[str, Vector] = {}
    """target points of the tips inside the object, in its frame [m], by finger"""
    depth: Positive = Field(0.01, le=0.2)
    """depth of a target point below a planned contact [m]"""
    speed: Positive = Field(0.03, le=1.0)
    """speed of the tip with the longest way [m/s]"""
    touch: Positive = 0.3
    """force at which a tip touches the object [N]"""
    seconds: Positive = 3.0
    """time within which all tips must touch the object [s]"""


class SqueezeStep(Table):
    """Raise the internal forces of the grasp."""

    do: Literal["squeeze"] = "squeeze"
    """the kind of step"""
    grip: Positive
    """force of the opposing finger, shared by the others [N]"""
    seconds: Positive = 0.5
    """duration of the rise [s]"""


class ShiftStep(Table):
    """Move the object with the fingers."""

    do: Literal["shift"] = "shift"
    """the kind of step"""
    by: Vector
    """displacement of the object in the world's frame [m]"""
    seconds: Positive = 1.0
    """duration [s]"""


class HoldStep(Table):
    """Hold the object in place."""

    do: Literal["hold"] = "hold"
    """the kind of step"""
    seconds: Positive
    """duration [s]"""


class ReleaseStep(Table):
    """Reduce the forces to zero, then withdraw the tips from the object."""

    do: Literal["release"] = "release"
    """the kind of step"""
    way: Positive = Field(0.015, le=0.2)
    """distance by which the tips withdraw [m]"""
    seconds: Positive = 1.0
    """duration [s], half of it for the forces"""


Step = PreshapeStep | CloseStep | SqueezeStep | ShiftStep | HoldStep | ReleaseStep
GRIPPING = (SqueezeStep, ShiftStep, HoldStep, ReleaseStep)
"""Steps that need a gripped object."""


class GraspProgram(Program):
    """Postures and steps of a grasp."""

    opposing: str = "thumb"
    """name of the finger that opposes all others"""
    posture: Mapping[str, Posture] = {}
    """joint positions of every finger [rad], by posture"""
    step: tuple[Annotated[Step, Field(discriminator="do")], ...] = Field((), max_length=MAX_STEPS)
    """steps, executed in order"""

    def find_mismatches(self, robot: RobotConfig | None, scene: SceneConfig) -> Mismatches:
        """Yield the key, value and reason of each mistake in the program.

        Mistakes are fingers, postures or objects that do not exist, and steps in the wrong order.
        """
        if robot is None or robot.hand is None:
            return
        hand = robot.hand
        names = [finger.name for finger in hand.finger]
        if self.opposing not in names:
            yield (
                "opposing",
                self.opposing,
                f"the hand has no such finger; fingers: {', '.join(names)}",
            )
        for name, posture in self.posture.items():
            yield from _check_posture(f"posture.{name}", posture, hand)
        gripped = False
        for k, step in enumerate(self.step):
            if isinstance(step, PreshapeStep) and step.posture not in self.posture:
                yield (
                    f"step[{k}].posture",
                    step.posture,
                    f"no such posture; postures: {_list_names(self.posture)}",
                )
            if isinstance(step, CloseStep):
                yield from _check_close_step(f"step[{k}]", step, self.opposing, names, scene)
            if isinstance(step, GRIPPING) and not gripped:
                yield (
                    f"step[{k}].do",
                    step.do,
                    "it needs a gripped object: a 'close' must come before it",
                )
            if gripped and isinstance(step, (PreshapeStep, CloseStep)):
                yield (
                    f"step[{k}].do",
                    step.do,
                    "an object is gripped: a 'release' must come before it",
                )
            gripped = isinstance(step, CloseStep) or (gripped and not isinstance(step, ReleaseStep))


def _check_posture(key: str, posture: Posture, hand: HandConfig) -> Mismatches:
    """Yield a mismatch for each unknown or missing finger and each wrong number of joint values."""
    names = {finger.name: len(finger.joints) for finger in hand.finger}
    for name, values in posture.items():
        if name not in names:
            yield (
                f"{key}.{name}",
                list(values),
                f"the hand has no such finger; fingers: {', '.join(names)}",
            )
        elif len(values) != names[name]:
            yield (
                f"{key}.{name}",
                list(values),
                f"{len(values)} values; it needs {names[name]}, one per joint",
            )
    if missing := [name for name in names if name not in posture]:
        yield key, list(posture), f"the posture lacks {', '.join(missing)}"


def _check_close_step(
    key: str, step: CloseStep, opposing: str, names: list[str], scene: SceneConfig
) -> Mismatches:
    """Yield a mismatch for an unknown object or finger, and for an incomplete set of points.

    There must be a point for the opposing finger and for at least one other finger.
    """
    if step.object not in scene.objects:
        yield (
            f"{key}.object",
            step.object,
            f"not in the scene; objects: {_list_names(scene.objects)}",
        )
    for name in step.points:
        if name not in names:
            yield (
                f"{key}.points.{name}",
                name,
                f"the hand has no such finger; fingers: {', '.join(names)}",
            )
    if step.points and (opposing not in step.points or len(step.points) < 2):
        yield (
            f"{key}.points",
            list(step.points),
            f"it needs the opposing finger, '{opposing}', and another one",
        )


def _list_names(names: Any) -> str:
    """Return the names separated by commas, or "none"."""
    return ", ".join(names) or "none"
