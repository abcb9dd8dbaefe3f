"""Facts about the levels of a rack, published as plain data for tools.

The launch gathers them from the levels' classes and stores them as text in the segment and in run
folders. Tools that show or command a rack read this text. They never import the classes that a
config names, because that would run code of whoever wrote the config.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from pydantic import TypeAdapter

from rack.backplane.errors import SegmentError
from rack.backplane.json_text import encode_json
from rack.backplane.segment import Segment
from rack.boards.config.connections import find_executors, has_operator_port
from rack.boards.config.schedulers import list_valid_schedulers, names_scheduler
from rack.boards.config.schema import RackConfig
from rack.boards.faults.kind import KINDS, Kind
from rack.boards.faults.kinds import BUILT_IN
from rack.levels.errors import LevelError
from rack.levels.level import Executor
from rack.levels.operator import NAMED_OPERATIONS, Goal, Operation
from rack.levels.tables import list_live_keys


@dataclass(frozen=True)
class PublishedFinding:
    """Event that a level declares and may report: see `rack.levels.ports.FindingKind`."""

    name: str
    unit: str
    meaning: str


@dataclass(frozen=True)
class PublishedLevel:
    """Facts about a level that operator commands and fault injection need.

    Attributes:
        commands: Operator commands that it takes, each with the valid forms of its goal.
        wording: Valid names for each command that takes a name. Commands whose names are not known
            are left out.
        names: Names to which the level's alarms refer by index. See `Executor.list_names`.
        struck_by: Fault kinds that can affect the hardware that it drives.
        findings: Events that it declares, in the order of their numbers.
    """

    commands: Mapping[Operation, tuple[Goal, ...]] = field(default_factory=dict)
    wording: Mapping[Operation, tuple[str, ...]] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    struck_by: tuple[str, ...] = ()
    findings: tuple[PublishedFinding, ...] = ()

    @property
    def live_keys(self) -> tuple[str, ...]:
        """Keys of its live parameters."""
        return self.wording.get(Operation.SET, ())


Levels = Mapping[str, PublishedLevel]
"""Levels, keyed by board. Levels whose classes are missing are left out."""


@dataclass(frozen=True)
class PublishedRack:
    """Published levels of a rack, and the fault kinds that the levels' modules define."""

    levels: Levels = field(default_factory=dict)
    kinds: tuple[Kind, ...] = ()

    def to_json(self) -> str:
        """Return the record as JSON, without the functions and classes in fault kinds."""
        return encode_json(ADAPTER.dump_python(self, exclude=CODE))

    @classmethod
    def read(cls, text: str) -> PublishedRack:
        """Read a record from JSON and register its fault kinds in this process.

        Raises:
            ValueError: The text is not a valid record.
        """
        published = ADAPTER.validate_json(text)
        KINDS.add_missing(published.kinds)
        return published

    @classmethod
    def read_from_segment(cls, segment: Segment) -> PublishedRack:
        """Read the record that a rack has published. Raises `SegmentError` if it is not valid."""
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
"""Fields that are not published because they contain functions or classes."""


def gather_facts(config: RackConfig) -> PublishedRack:
    """Import the levels of a rack and return the facts to be published about them."""
    levels = {
        name: _describe_level(config, name, kind) for name, kind in find_executors(config).items()
    }
    return PublishedRack(levels, tuple(kind for kind in KINDS if kind.name not in BUILT_IN))


def _describe_level(config: RackConfig, board: str, kind: type[Executor]) -> PublishedLevel:
    """Return the facts to be published about the level of one board."""
    commands = dict(kind.commands) if has_operator_port(kind) else {}
    params = config.board[board].params
    wording = {Operation.SET: list_live_keys(kind.params)}
    if names_scheduler(config):
        commands[Operation.SCHEDULE] = ()
        wording[Operation.SCHEDULE] = list_valid_schedulers(config)
    if config.board[board].standby:
        commands[Operation.SWITCH] = ()
    for what in commands.keys() & {*NAMED_OPERATIONS} - wording.keys():
        # A state table may be invalid while it is being edited.
        with suppress(LevelError):
            wording[what] = tuple(kind.list_operation_names(what, params, config.scene))
    return PublishedLevel(
        commands={what: tuple(goals) for what, goals in commands.items()},
        wording=wording,
        names=tuple(kind.list_names(params)),
        struck_by=tuple(k.name for k in KINDS if isinstance(k.step, kind.faults)),
        findings=tuple(
            PublishedFinding(finding.name, finding.unit, finding.doc)
            for finding in kind.finding_kinds.values()
        ),
    )
