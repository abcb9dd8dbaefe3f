"""The state of a rack at its end, before its memory is released: its faults, its levels, its
arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rack.backplane.fault_table import Entry, FaultTable, Injection, Stage
from rack.backplane.message import State
from rack.backplane.segment import Segment
from rack.boards.events import statuses
from rack.boards.faults.bounds import struck_mailboxes
from rack.boards.faults.describe import board_of
from rack.boards.faults.kind import KINDS, Kind
from rack.levels.messages import Error

EXTERNAL = "external kill"
"""The kind, in reports, of a SIGKILL that a campaign itself sends, without the fault table."""

AT_REST = 0.02
"""Joint velocity below which an arm is at rest, rad/s."""


def record_of(kind: str) -> Kind:
    """Return the record of a kind in reports; a kill from outside is like any other."""
    return KINDS["kill" if kind == EXTERNAL else kind]


@dataclass(frozen=True)
class Killed:
    """A kill from outside, at `tick` and at CLOCK_MONOTONIC `time_ns`."""

    board: str
    tick: int
    time_ns: int


@dataclass(frozen=True)
class Strike:
    """A fault as the fault table holds it at the end of the run.

    `began` is its tick, -1: it did not begin; `ends` that of its end, in the run or planned, or
    `NEVER`. `tick` and `time_ns` (CLOCK_MONOTONIC) are those at which it first acted, however
    little (-1: it did not). `count` is how often it acted so much that it must be found, and
    `hidden` the ticks from `tick` to the first time. `mailboxes` are those concerned; `joint` is a
    name, or "" for none or all.
    """

    fault: int
    kind: str
    board: str
    began: int
    ends: int
    tick: int
    time_ns: int = 0
    count: int = 1
    hidden: int = 0
    mailboxes: tuple[str, ...] = ()
    joint: str = ""
    size: float | None = None
    injection: Injection | None = None

    @property
    def record(self) -> Kind:
        """The kind's record."""
        return record_of(self.kind)


@dataclass(frozen=True)
class ArmEnd:
    """An arm at the end of a run: limits violated and touches, counted at every substep; whether it
    is at rest."""

    violations: int = 0
    touches: int = 0
    is_at_rest: bool = True


def strikes(segment: Segment, joints: Sequence[str], kills: Sequence[Killed]) -> tuple[Strike, ...]:
    """Return everything injected into a rack, in the order of the fault table, kills from outside
    last."""
    table = FaultTable(segment)
    found = [
        _strike(segment, e.index, joints, table) for e in table.entries if e.stage != Stage.FREE
    ]
    return (*found, *(_killed(segment, kill) for kill in kills))


def arm_of(segment: Segment) -> ArmEnd:
    """Return the arm of a rack as its levels last reported it; a rack without one violates no
    limit."""
    seen = [status for _, status in statuses(segment, "violations")]
    return ArmEnd(
        violations=max((int(arm.violations) for arm in seen), default=0),
        touches=max((int(arm.touches) for arm in seen), default=0),
        is_at_rest=all(np.abs(arm.velocity).max() < AT_REST for arm in seen),
    )


def levels_of(segment: Segment) -> str:
    """Return the last state of each level, with its reason, as one readable text."""
    states = []
    for writer, status in statuses(segment, "reason"):
        state = State(status.state).name.lower()
        reason = status.reason
        states.append(f"{writer} {state}{f' ({reason})' if reason else ''}")
    return ", ".join(states)


def is_late(segment: Segment) -> bool:
    """Return whether a level gave up because it cannot meet a time."""
    return any(
        s.state == State.ERROR and s.error == Error.TOO_LATE for _, s in statuses(segment, "error")
    )


def _strike(segment: Segment, index: int, joints: Sequence[str], table: FaultTable) -> Strike:
    entry = table.entries[index]
    layout = segment.layout
    kind = KINDS[entry[Entry.KIND]]
    values = kind.values(entry)
    board = board_of(entry, layout)
    joint = int(values.get("joint", -1))
    begun = entry.stage != Stage.WAITING
    return Strike(
        fault=index,
        kind=kind.name,
        board=board,
        began=entry[Entry.FROM] if begun else -1,
        ends=entry[Entry.UNTIL],
        tick=entry[Entry.STRUCK_TICK],
        time_ns=entry[Entry.STRUCK_NS],
        count=entry[Entry.COUNT],
        hidden=entry[Entry.HIDDEN],
        mailboxes=tuple(box.name for box in struck_mailboxes(layout, entry[Entry.MAILBOX], board)),
        joint=joints[joint] if 0 <= joint < len(joints) else "",
        size=values.get("size"),
        injection=Injection(
            kind=entry[Entry.KIND],
            task=entry[Entry.TASK],
            mailbox=entry[Entry.MAILBOX],
            ticks=entry[Entry.TICKS],
            phase=entry[Entry.PHASE],
            seed=entry[Entry.SEED],
            parameters=tuple(entry.parameters[: len(kind.parameters)]),
        ),
    )


def _killed(segment: Segment, kill: Killed) -> Strike:
    return Strike(
        fault=-1,
        kind=EXTERNAL,
        board=kill.board,
        began=kill.tick,
        ends=kill.tick,
        tick=kill.tick,
        time_ns=kill.time_ns,
        mailboxes=tuple(box.name for box in struck_mailboxes(segment.layout, -1, kill.board)),
    )
