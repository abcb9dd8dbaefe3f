"""Control modifications ("cmods"): a user's function before, in place of, or after a servo law.

A modification is a class in the user's own package. The parameters of a board with a servo law name
it:

    [board.servo.params.modifications.friction]
    class = "my_package.my_module:Friction"
    on = false
    params = { torque = 2.0 }

It is switched on and off between two samples: from the start if `on` is true, later by an
operator's command. `rack.levels.servo.modified_law` describes how switching avoids a step in the
torque, and what happens to a modification that fails.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field, StringConstraints, field_validator, model_validator

from rack.levels.algebra import Array
from rack.levels.errors import LevelError
from rack.levels.level import LevelContext, Mismatches
from rack.levels.operator import MAX_NAME_BYTES
from rack.levels.robot.cell import build_level_cell
from rack.levels.servo.curves import Motion
from rack.levels.tables import Positive, Table, read_params, validate_class


class Hook(StrEnum):
    """Positions of a modification relative to the servo law."""

    BEFORE = "before"  # changes the wanted motion or the state before the law sees it
    INSTEAD = "instead"  # sets the torque in place of the law
    AFTER = "after"  # changes the law's torque


class LawContext(NamedTuple):
    """Facts about the servo law that a modification may need.

    Vectors are (joints,), for all joints of the arm.
    """

    joints: Sequence[str]  # names of the joints
    period_s: float  # time between samples, unless cycles are missed
    torque: Array  # N m: torque limits, which also apply after every modification
    params: Mapping[str, Any]  # params of the modification in the config


class LawSample:
    """One sample of a servo law.

    Vectors are (joints,), for all joints of the arm; assigning to one fills it in place. Values of
    joints that the board does not drive are meaningless, and changes to them are ignored.
    """

    __slots__ = (
        "inertia",
        "load",
        "motion",
        "position",
        "seen",
        "tick",
        "torque",
        "velocity",
        "wanted_acceleration",
        "wanted_position",
        "wanted_velocity",
    )

    def __init__(self, joints: int) -> None:
        self.tick = 0  # tick of the sample
        # Inputs of the law. Its rows are the next five vectors, in rad, rad/s, rad/s2, rad, rad/s.
        self.seen: Array = np.zeros((5, joints))
        self.wanted_position, self.wanted_velocity, self.wanted_acceleration = self.seen[:3]
        self.position, self.velocity = self.seen[3:]  # sensed
        self.motion = Motion(self.seen[:3])
        self.inertia: Array = np.zeros(joints)  # kg m2: diagonal of the joint-space inertia
        # N m: torques of gravity and velocities, without acceleration and dry friction.
        self.load: Array = np.zeros(joints)
        # N m: torques of the law. They are NaN for modifications before the law or in its place.
        self.torque: Array = np.zeros(joints)

    def __setattr__(self, name: str, value: Any) -> None:
        """Fill vectors in place, so that the caller of the law sees the change.

        For example, `sample.torque = 0.9 * sample.torque` scales the torques that the arm gets.
        """
        if isinstance(getattr(self, name, None), np.ndarray):
            getattr(self, name)[...] = value
        else:
            object.__setattr__(self, name, value)


class Modification(ABC):
    """A control modification. Subclasses declare their hook and define `modify`."""

    hook: ClassVar[Hook]
    params: ClassVar[type[Table] | None] = None
    """Table of its `params` in the config, checked before the launch. None if it takes none."""

    def __init__(self, context: LawContext) -> None:
        """Raise `LevelError` for params that do not suit the law; `rack check` reports it."""
        self.context = context

    def begin(self, sample: LawSample) -> None:
        """Reset internal state. The default does nothing.

        Called in the first sample after the modification was switched on, before `modify`.
        """

    @abstractmethod
    def modify(self, sample: LawSample) -> None:
        """Change one sample in bounded time: the law's inputs or the torque, depending on the hook.

        After an exception or a result that is not finite, the change is undone and the modification
        is switched off.
        """


class ModificationConfig(Table):
    """`[board.<name>.params.modifications.<modification>]`: one modification of a servo law."""

    cls: str = Field(alias="class")
    """subclass of rack.levels.servo.Modification, package.module:Class"""
    on: bool = False
    """switched on from the start"""
    params: dict[str, Any] = {}
    """parameters of the modification, declared by its class"""

    @field_validator("cls")
    @classmethod
    def _check_hook(cls, reference: str) -> str:
        """Check that the class can be loaded and declares a valid hook."""
        hook = getattr(validate_class(reference, Modification), "hook", None)
        hooks = [str(hook) for hook in Hook]
        if hook not in hooks:
            raise ValueError(
                f"class '{reference.partition(':')[2]}' has the hook {hook!r}; must be one of"
                f" {', '.join(hooks)}"
            )
        return reference

    @model_validator(mode="after")
    def _check_params(self) -> ModificationConfig:
        """Check the params against the table of parameters that the class declares."""
        kind = self.kind.params
        if kind is not None:
            try:
                read_params(kind, self.params)
            except LevelError as error:
                raise ValueError(str(error)) from None
        elif self.params:
            raise ValueError(f"'{self.cls.partition(':')[2]}' takes no params; remove them")
        return self

    @property
    def kind(self) -> type[Modification]:
        """Class of the modification."""
        return validate_class(self.cls, Modification)


ModificationName = Annotated[
    str, StringConstraints(pattern=rf"^[a-z][a-z0-9_-]{{0,{MAX_NAME_BYTES - 1}}}$")
]


class ModifiableParams(Table):
    """Parameters of a board whose servo law can be modified."""

    modifications: dict[ModificationName, ModificationConfig] = {}
    """control modifications by name, in the order in which they act"""
    transfer: Positive = Field(0.05, le=10.0)
    """time in which the torque changes over after a modification is switched [s]"""

    @field_validator("modifications")
    @classmethod
    def _check_instead(
        cls, entries: dict[str, ModificationConfig]
    ) -> dict[str, ModificationConfig]:
        """Check that at most one modification that replaces the law is initially on."""
        active = [
            name for name, entry in entries.items() if entry.on and entry.kind.hook == Hook.INSTEAD
        ]
        if len(active) > 1:
            raise ValueError(f"only one may be on in place of the law, not {', '.join(active)}")
        return entries


def list_names(params: Mapping[str, Any]) -> Sequence[str]:
    """Return the names of the modifications in a board's parameters.

    The parameters need not be valid.
    """
    table = params.get("modifications")
    return tuple(table) if isinstance(table, Mapping) else ()


def find_unsuitable_modifications(context: LevelContext) -> Mismatches:
    """Yield a mismatch for each modification that does not suit the law of its board."""
    params = read_params(
        ModifiableParams, {"modifications": context.params.get("modifications", {})}
    )
    if not params.modifications:
        return
    torque = build_level_cell(context).bounds.torque
    for name, entry in params.modifications.items():
        try:
            entry.kind(LawContext(context.robot.joints, context.period_s, torque, entry.params))
        except LevelError as error:
            yield f"params.modifications.{name}", None, str(error)
