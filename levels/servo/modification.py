"""Control modifications ("cmods"): a user's own function before, in place of, or after a servo law.

A modification is a class in the user's own package, named in the parameters of a board with a servo
law:

    [board.servo.params.modifications.friction]
    class = "my_package.my_module:Friction"
    on = false
    params = { torque = 2.0 }

It is put in and taken out between two samples, by `on` at the start and by an operator's command at
a tick. See `rack.levels.servo.modified_law` for the switch without a step, and for what happens to
one that fails.
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
from rack.levels.level import LevelContext, Misfits
from rack.levels.operator import NAME_BYTES
from rack.levels.robot.cell import cell_of
from rack.levels.servo.curves import Motion
from rack.levels.tables import Positive, Table, named_class, read_params


class Hook(StrEnum):
    """Places of a modification around a servo law."""

    BEFORE = "before"  # changes the motion wanted, or the state, as the law sees them
    INSTEAD = "instead"  # sets the torque in place of the law
    AFTER = "after"  # changes the law's torque


class LawContext(NamedTuple):
    """The servo law as a modification knows it. Vectors are (joints,), of all joints of the arm."""

    joints: Sequence[str]  # names
    period_s: float  # from sample to sample, unless cycles are missed
    torque: Array  # N m: limits, which stay in force after every modification
    params: Mapping[str, Any]  # of the modification, as given


class LawSample:
    """One sample of a servo law. Vectors are (joints,), of all joints of the arm; assigning to one
    fills it.

    Joints that the board does not drive have values without a meaning; what becomes of them is
    ignored.
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
        self.tick = 0  # of the sample
        self.seen: Array = np.zeros(
            (5, joints)
        )  # what the law sees: the next five, which are its rows
        self.wanted_position, self.wanted_velocity, self.wanted_acceleration = self.seen[
            :3
        ]  # rad, rad/s, rad/s2
        self.position, self.velocity = self.seen[3:]  # rad, rad/s: sensed
        self.motion = Motion(self.seen[:3])
        self.inertia: Array = np.zeros(joints)  # kg m2: diagonal of the joint-space inertia
        self.load: Array = np.zeros(
            joints
        )  # N m: torque of gravity and motion, without acceleration and dry friction
        self.torque: Array = np.zeros(joints)  # N m: the law's; NaN before it, and in its place

    def __setattr__(self, name: str, value: Any) -> None:
        """Fill a vector in place: `sample.torque = 0.9 * sample.torque` changes what the law's
        caller sees.
        """
        if isinstance(getattr(self, name, None), np.ndarray):
            getattr(self, name)[...] = value
        else:
            object.__setattr__(self, name, value)


class Modification(ABC):
    """A control modification. Subclasses declare their hook, and write `modify`."""

    hook: ClassVar[Hook]
    params: ClassVar[type[Table] | None] = None
    """Keys of its `params` in the config, checked before the launch; None: it takes none."""

    def __init__(self, context: LawContext) -> None:
        """Raise `LevelError` for params that do not suit the law: `rack check` reports it."""
        self.context = context

    def begin(self, sample: LawSample) -> None:
        """Start anew in the first sample after it is put in, before `modify`. Default: nothing."""

    @abstractmethod
    def modify(self, sample: LawSample) -> None:
        """Change one sample, in bounded time: what the law sees, or the torque, by the hook.

        An exception, or a value that is not finite, undoes the change and takes the modification
        out.
        """


class ModificationConfig(Table):
    """`[board.<name>.params.modifications.<modification>]`: one modification of the board's servo
    law.
    """

    cls: str = Field(alias="class")
    """subclass of rack.levels.servo.Modification, package.module:Class"""
    on: bool = False
    """put in from the start"""
    params: dict[str, Any] = {}
    """parameters of the modification, declared by its class"""

    @field_validator("cls")
    @classmethod
    def _has_a_hook(cls, reference: str) -> str:
        hook = getattr(named_class(reference, Modification), "hook", None)
        known = [str(hook) for hook in Hook]
        if hook not in known:
            name = reference.partition(":")[2]
            raise ValueError(f"class '{name}' has the hook {hook!r}; permitted: {', '.join(known)}")
        return reference

    @model_validator(mode="after")
    def _fits_its_class(self) -> ModificationConfig:
        kind = self.kind.params
        if kind is None:
            if self.params:
                raise ValueError(f"'{self.cls.partition(':')[2]}' takes no params; remove them")
            return self
        try:
            read_params(kind, self.params)
        except LevelError as error:
            raise ValueError(str(error)) from None
        return self

    @property
    def kind(self) -> type[Modification]:
        """The class."""
        return named_class(self.cls, Modification)


ModificationName = Annotated[
    str, StringConstraints(pattern=rf"^[a-z][a-z0-9_-]{{0,{NAME_BYTES - 1}}}$")
]


class ModifiableParams(Table):
    """Parameters of a board whose servo law can be modified."""

    modifications: dict[ModificationName, ModificationConfig] = {}
    """control modifications by name, in the order in which they act"""
    transfer: Positive = Field(0.05, le=10.0)
    """time in which the torque goes over to that of a law modified otherwise [s]"""

    @field_validator("modifications")
    @classmethod
    def _one_instead(cls, found: dict[str, ModificationConfig]) -> dict[str, ModificationConfig]:
        first = [
            name for name, entry in found.items() if entry.on and entry.kind.hook == Hook.INSTEAD
        ]
        if len(first) > 1:
            raise ValueError(f"{', '.join(first)} are on in place of the law; permitted: one")
        return found


def names_of(params: Mapping[str, Any]) -> Sequence[str]:
    """Return the names of the modifications in a board's parameters, valid or not: see
    `Executor.names`.
    """
    found = params.get("modifications")
    return tuple(found) if isinstance(found, Mapping) else ()


def misfits_of(context: LevelContext) -> Misfits:
    """Yield the modifications of a board that do not suit its law: see `Executor.misfits`."""
    params = read_params(
        ModifiableParams, {"modifications": context.params.get("modifications", {})}
    )
    if not params.modifications:
        return
    torque = cell_of(context).bounds.torque
    for name, entry in params.modifications.items():
        try:
            entry.kind(LawContext(context.robot.joints, context.period_s, torque, entry.params))
        except LevelError as error:
            yield f"params.modifications.{name}", None, str(error)
