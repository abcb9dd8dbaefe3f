"""Facts about a rack's levels, published as plain data for everything that is not the rack itself.

They are gathered from the levels' classes when the rack is launched, and stand as text in its
segment and in the folders of its runs. What looks at a rack or a run, or commands it, reads them
there: it imports no class that a config names, since that would run the code of whoever wrote it.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from math import isfinite
from typing import Any, Literal, get_args

from pydantic import Field, TypeAdapter, create_model
from pydantic.fields import FieldInfo

from rack.backplane.errors import SegmentError
from rack.backplane.json_text import encode_json
from rack.backplane.segment import Segment
from rack.boards.config.connections import executors, takes_commands
from rack.boards.config.schema import RackConfig
from rack.boards.faults.kind import KINDS, Kind
from rack.boards.faults.kinds import BUILT_IN
from rack.levels.errors import LevelError
from rack.levels.level import Executor
from rack.levels.operator import NAMED, Goal, Operation
from rack.levels.tables import Table, keys_of, live_keys, read_params

TYPES: Mapping[str, type] = {kind.__name__: kind for kind in (bool, int, float, str)}
"""Types of parameters whose values can be checked without the level's class."""
Constraint = Literal["gt", "ge", "lt", "le", "allow_inf_nan"]


@dataclass(frozen=True)
class PublishedParam:
    """A parameter that an operator may set while its level runs.

    Attributes:
        kind: Name of its type in `TYPES`. Empty: the level alone can check its values.
        meaning: Its meaning, with its unit.
        constraints: Bounds of its values, by the names that pydantic has for them.
        launched: Its value at the launch, as text.
    """

    kind: str
    meaning: str
    constraints: Mapping[Constraint, float | bool]
    launched: str


@dataclass(frozen=True)
class PublishedFinding:
    """An event of its own that a level may report: see `rack.levels.ports.FindingKind`."""

    name: str
    unit: str
    meaning: str


@dataclass(frozen=True)
class PublishedLevel:
    """A level, as its operator and the injector of faults know it.

    Attributes:
        commands: The operator's commands that it takes, with the forms of their goals.
        wording: Names that each command with a name may give. A command is missing if its names are
            not known.
        names: See `Executor.names`.
        keys: Keys of all its parameters.
        live: Its live parameters by key.
        struck_by: Kinds of faults that can strike the hardware that it drives.
        findings: Events of its own that it may report, in the order of their numbers.
    """

    commands: Mapping[Operation, tuple[Goal, ...]] = field(default_factory=dict)
    wording: Mapping[Operation, tuple[str, ...]] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()
    live: Mapping[str, PublishedParam] = field(default_factory=dict)
    struck_by: tuple[str, ...] = ()
    findings: tuple[PublishedFinding, ...] = ()

    @property
    def table(self) -> type[Table]:
        """A table that checks the values of live parameters."""
        fields: dict[str, Any] = dict.fromkeys(self.keys, (Any, None))
        for key, param in self.live.items():
            constraints: Any = param.constraints
            declared = Field(None, description=param.meaning, **constraints)
            fields[key] = (TYPES.get(param.kind, Any), declared)
        return create_model("Params", __base__=Table, **fields)


Levels = Mapping[str, PublishedLevel]
"""Levels by board; those whose classes are missing are omitted."""


@dataclass(frozen=True)
class PublishedRack:
    """The levels of a rack, and the kinds of faults that their modules add."""

    levels: Levels = field(default_factory=dict)
    kinds: tuple[Kind, ...] = ()

    def text(self) -> str:
        """Return it as text, without the parts of kinds that are code."""
        return encode_json(ADAPTER.dump_python(self, exclude=CODE))

    @classmethod
    def read(cls, text: str) -> PublishedRack:
        """Return what a text contains. Its kinds of faults are known to this process from now on.

        Raises:
            ValueError: The text is no such record.
        """
        found = ADAPTER.validate_json(text)
        KINDS.adopt(found.kinds)
        return found

    @classmethod
    def of_rack(cls, segment: Segment) -> PublishedRack:
        """Return what a rack has published. Raises `SegmentError`."""
        try:
            return cls.read(segment.published)
        except ValueError as error:
            why = " ".join(str(error).split())
            raise SegmentError(f"rack '{segment.rack}': published levels: {why}") from None


ADAPTER = TypeAdapter(PublishedRack)
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
"""Fields that are left out, because they hold functions or classes."""


def publish(config: RackConfig) -> PublishedRack:
    """Gather the facts about a rack's levels from their classes, which are imported."""
    levels = {name: _level(config, name, kind) for name, kind in executors(config).items()}
    return PublishedRack(levels, tuple(kind for kind in KINDS if kind.name not in BUILT_IN))


def _level(config: RackConfig, board: str, kind: type[Executor]) -> PublishedLevel:
    commands = kind.commands if takes_commands(kind) else {}
    given = config.board[board].params
    live: dict[str, PublishedParam] = {}
    if kind.params is not None and (keys := live_keys(kind.params)):
        declared = keys_of(kind.params)
        launched = None
        # Of parameters with mistakes, which are reported elsewhere, no value is known.
        with suppress(LevelError):
            launched = read_params(kind.params, given)
        live = {key: _param(declared[key], getattr(launched, key, "")) for key in keys}
    wording = {Operation.SET: tuple(live)}
    for what in commands.keys() & {*NAMED} - {Operation.SET}:
        # A table may be in the middle of being edited.
        with suppress(LevelError):
            wording[what] = tuple(kind.wording(what, given, config.scene))
    return PublishedLevel(
        commands={what: tuple(goals) for what, goals in commands.items()},
        wording=wording,
        names=tuple(kind.names(given)),
        keys=() if kind.params is None else tuple(kind.params.model_fields),
        live=live,
        struck_by=tuple(k.name for k in KINDS if isinstance(k.step, kind.faults)),
        findings=tuple(
            PublishedFinding(one.name, one.unit, one.doc) for one in kind.finding_kinds.values()
        ),
    )


def _param(declared: FieldInfo, launched: object) -> PublishedParam:
    constraints: dict[Constraint, float | bool] = {}
    for bound in declared.metadata:
        for key in get_args(Constraint):
            value = getattr(bound, key, None)
            # An infinite bound is none, and JSON has no infinity.
            if value is not None and isfinite(value):
                constraints[key] = value if isinstance(value, bool) else float(value)
    kind = getattr(declared.annotation, "__name__", "")
    is_known = kind in TYPES
    return PublishedParam(
        kind, declared.description or "", constraints if is_known else {}, str(launched)
    )
