"""Facts about a rack's levels, published as plain data for everything that is not the rack itself.

They are gathered from the levels' classes when the rack is launched, and stand as text in its
segment and in the folders of its runs. What looks at a rack or a run, or commands it, reads them
there: it imports no class that a config names, since that would run the code of whoever wrote it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal

from pydantic import Field, TypeAdapter, ValidationError, create_model
from pydantic.fields import FieldInfo

from rack.backplane.errors import SegmentError
from rack.backplane.segment import Segment
from rack.boards.config.schema import RackConfig
from rack.boards.config.wiring import commandable, executors
from rack.boards.faults.kind import KINDS, Kind
from rack.boards.faults.kinds import BUILT_IN
from rack.levels.errors import LevelError
from rack.levels.level import Executor
from rack.levels.operator import NAMED, Commands, Goal, Operation
from rack.levels.tables import Table, keys_of, live_keys, read_params

MOST_BYTES = 1_000_000
"""Largest text that is read."""
TYPES: Mapping[str, type] = {kind.__name__: kind for kind in (bool, int, float, str)}
"""Types of parameters whose values can be checked without the level's class."""
Constraint = Literal["gt", "ge", "lt", "le", "allow_inf_nan"]
CONSTRAINTS: tuple[Constraint, ...] = ("gt", "ge", "lt", "le", "allow_inf_nan")


@dataclass(frozen=True)
class PublishedParam:
    """A parameter of a level. All but `is_live` is known of live ones only.

    Attributes:
        is_live: An operator may set it while the level runs.
        kind: Name of its type in `TYPES`. Empty: the level alone can check its values.
        meaning: Its meaning, with its unit.
        constraints: Bounds of its values, by the names that pydantic has for them.
        launched: Its value at the launch, as text.
    """

    is_live: bool = False
    kind: str = ""
    meaning: str = ""
    constraints: Mapping[Constraint, float | bool] = field(default_factory=dict)
    launched: str = ""


@dataclass(frozen=True)
class PublishedLevel:
    """A level, as its operator and the injector of faults know it.

    Attributes:
        has_operator: It reads an operator's commands.
        commands: The operator's commands that it takes, with the forms of their goals.
        wording: Names that each command with a name may give. A command is missing if its names are
            not known.
        names: See `Executor.names`.
        params: Its parameters by key.
        struck_by: Kinds of faults that can strike the hardware that it drives.
    """

    has_operator: bool = False
    commands: Mapping[Operation, tuple[Goal, ...]] = field(default_factory=dict)
    wording: Mapping[Operation, tuple[str, ...]] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    params: Mapping[str, PublishedParam] = field(default_factory=dict)
    struck_by: tuple[str, ...] = ()

    @property
    def live(self) -> tuple[str, ...]:
        """Keys of the parameters that an operator may set while the level runs."""
        return tuple(key for key, param in self.params.items() if param.is_live)

    @property
    def table(self) -> type[Table]:
        """A table that checks the values of parameters, as far as they are published."""
        fields: dict[str, Any] = {
            key: (TYPES.get(p.kind, Any), Field(None, description=p.meaning, **p.constraints))
            for key, p in self.params.items()
        }
        return create_model("Params", __base__=Table, **fields)


Levels = Mapping[str, PublishedLevel]
"""Levels by board; those whose classes are missing are omitted."""


@dataclass(frozen=True)
class Published:
    """The levels of a rack, and the kinds of faults that their modules add."""

    levels: Levels = field(default_factory=dict)
    kinds: tuple[Kind, ...] = ()

    def text(self) -> str:
        """Return it as text, without the parts of kinds that are code."""
        return json.dumps(_adapter().dump_python(self, exclude=CODE))

    @classmethod
    def read(cls, text: str) -> Published:
        """Return what a text contains. Its kinds of faults are known to this process from now on.

        Raises:
            ValueError: The text is no such record.
        """
        if len(text) > MOST_BYTES:
            raise ValueError(f"{len(text)} characters; permitted: {MOST_BYTES}")
        try:
            found = _adapter().validate_json(text)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
        KINDS.adopt(found.kinds)
        return found

    @classmethod
    def of_rack(cls, segment: Segment) -> Published:
        """Return what a rack has published. Raises `SegmentError`."""
        try:
            return cls.read(segment.published)
        except ValueError as error:
            raise SegmentError(f"rack '{segment.rack}': published levels: {error}") from None


CODE: Any = {
    "kinds": {
        "__all__": {
            "step": True,
            "lasts": True,
            "bound": {"ticks"},
            "parameters": {"__all__": {"drawn"}},
        }
    }
}
"""What is not published: functions and classes."""


@cache
def _adapter() -> TypeAdapter[Published]:
    return TypeAdapter(Published)


def publish(config: RackConfig) -> Published:
    """Gather the facts about a rack's levels from their classes, which are imported."""
    taken = commandable(config)
    levels = {
        name: _level(config, name, kind, taken.get(name))
        for name, kind in executors(config).items()
        if kind is not None
    }
    return Published(levels, tuple(kind for kind in KINDS if kind.name not in BUILT_IN))


def _level(
    config: RackConfig, board: str, kind: type[Executor], commands: Commands | None
) -> PublishedLevel:
    given = config.board[board].params
    wording: dict[Operation, tuple[str, ...]] = {}
    taken = {what: tuple(goals) for what, goals in (commands or {}).items()}
    for what in taken.keys() & {*NAMED} - {Operation.SET}:
        # A table may be in the middle of being edited.
        with suppress(LevelError):
            wording[what] = tuple(kind.wording(what, given, config.scene))
    return PublishedLevel(
        has_operator=commands is not None,
        commands=taken,
        wording=wording,
        names=tuple(kind.names(given)),
        params=_params(kind.params, given),
        struck_by=tuple(k.name for k in KINDS if isinstance(k.step, kind.faults)),
    )


def _params(kind: type[Table] | None, given: Mapping[str, Any]) -> dict[str, PublishedParam]:
    if kind is None:
        return {}
    live = live_keys(kind)
    found = dict.fromkeys(kind.model_fields, PublishedParam())
    if live:
        declared = keys_of(kind)
        launched = None
        # Of parameters with mistakes, which are reported elsewhere, no value is known.
        with suppress(LevelError):
            launched = read_params(kind, given)
        found |= {key: _live_param(declared[key], getattr(launched, key, "")) for key in live}
    return found


def _live_param(declared: FieldInfo, launched: object) -> PublishedParam:
    constraints: dict[Constraint, float | bool] = {}
    for bound in declared.metadata:
        for key in CONSTRAINTS:
            if (value := getattr(bound, key, None)) is not None:
                constraints[key] = value if isinstance(value, bool) else float(value)
    kind = next((name for name, found in TYPES.items() if found is declared.annotation), "")
    return PublishedParam(
        is_live=True,
        kind=kind,
        meaning=declared.description or "",
        constraints=constraints if kind else {},
        launched=str(launched),
    )
