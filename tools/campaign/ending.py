"""What a rack shows at its end, before its memory is given back: its faults, and its arm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rack.backplane.address_map import CLOCK
from rack.backplane.fault_table import Entry, FaultTable, Injection, Stage
from rack.backplane.layout import MailboxSpec
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.message import Message, State
from rack.backplane.segment import Segment
from rack.boards.faults.kinds import KINDS
from rack.levels.messages import Error
from rack.tools.campaign.external import Killed
from rack.tools.campaign.plan import EXTERNAL

AT_REST = 0.02
"""Joint velocity below which an arm stands, rad/s."""


@dataclass(frozen=True)
class Strike:
    """A fault as it was injected: what the fault table holds of it at the end of the run.

    `began` and `ends` are its ticks (-1: it did not begin, it did not end), `tick` and `time_ns` (CLOCK_MONOTONIC)
    when it first acted (-1: it did not), `count` how often. `mailboxes` are those concerned; `joint` is a
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
    mailboxes: tuple[str, ...] = ()
    joint: str = ""
    size: float | None = None
    injection: Injection | None = None


@dataclass(frozen=True)
class Arm:
    """An arm at the end of a run: limits violated and touches, counted at every substep; whether it stands."""

    violations: int = 0
    touches: int = 0
    is_at_rest: bool = True


def strikes(segment: Segment, joints: Sequence[str], kills: Sequence[Killed]) -> tuple[Strike, ...]:
    """Return what was injected into a rack, by whatever means, in the order of the fault table, kills last."""
    table = FaultTable(segment)
    found = [_strike(segment, e.index, joints, table) for e in table.entries if e.stage != Stage.FREE]
    return (*found, *(_killed(segment, kill) for kill in kills))


def arm_of(segment: Segment) -> Arm:
    """Return the arm of a rack as its levels last told of it; a rack without one breaks no limit."""
    seen = [arm for box in segment.layout.mailboxes for arm in _arms(segment, box)]
    return Arm(
        violations=max((arm.violations for arm in seen), default=0),
        touches=max((arm.touches for arm in seen), default=0),
        is_at_rest=all(arm.is_at_rest for arm in seen),
    )


def levels_of(segment: Segment) -> str:
    """Return the state that each level was left in, with its reason, as one readable text."""
    told = []
    for writer, status in _statuses(segment):
        state, reason = State(status.state).name.lower(), status.reason
        told.append(f"{writer} {state}{f' ({reason})' if reason else ''}")
    return ", ".join(told)


def is_late(segment: Segment) -> bool:
    """Say whether a level gave up because it cannot keep a time."""
    return any(status.state == State.ERROR and status.error == Error.TOO_LATE for _, status in _statuses(segment))


def _statuses(segment: Segment) -> Iterator[tuple[str, Message]]:
    """Yield the newest status of each level, with its writer."""
    for box in segment.layout.mailboxes:
        units = {field.name: field.unit for field in box.fields}
        # An arm's state, that of its simulation, is no level's.
        if units.get("state") != State.__name__ or "reason" not in units:
            continue
        if (status := open_observer(segment, box.name).peek()).is_there:
            yield box.writer, status.value


def _strike(segment: Segment, index: int, joints: Sequence[str], table: FaultTable) -> Strike:
    entry, layout = table.entries[index], segment.layout
    kind = KINDS[entry[Entry.KIND]]
    values = {p.name: entry.parameters[place] for place, p in enumerate(kind.parameters)}
    board = CLOCK if entry[Entry.TASK] < 0 else layout.tasks[entry[Entry.TASK]].name
    box, joint = entry[Entry.MAILBOX], int(values.get("joint", -1))
    begun = entry.stage != Stage.WAITING
    return Strike(
        fault=index,
        kind=kind.name,
        board=board,
        began=entry[Entry.FROM] if begun else -1,
        ends=entry[Entry.UNTIL] if entry.stage == Stage.OVER else -1,
        tick=entry[Entry.STRUCK_TICK],
        time_ns=entry[Entry.STRUCK_NS],
        count=entry[Entry.COUNT],
        mailboxes=(layout.mailboxes[box].name,) if box >= 0 else _written(segment, board),
        joint=joints[joint] if 0 <= joint < len(joints) else "",
        size=values.get("size"),
        injection=Injection(
            kind=entry[Entry.KIND],
            task=entry[Entry.TASK],
            mailbox=box,
            tick=entry[Entry.FROM],
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
        mailboxes=_written(segment, kill.board),
    )


def _written(segment: Segment, board: str) -> tuple[str, ...]:
    return tuple(box.name for box in segment.layout.mailboxes if box.writer == board)


def _arms(segment: Segment, box: MailboxSpec) -> Iterator[Arm]:
    names = {field.name for field in box.fields}
    if not {"position", "velocity", "torque"} <= names:
        return
    status = open_observer(segment, box.name).peek()
    if status.is_there:
        value = status.value
        yield Arm(
            violations=int(value.violations) if "violations" in names else 0,
            touches=int(value.touches) if "touches" in names else 0,
            is_at_rest=bool(np.abs(value.velocity).max() < AT_REST),
        )
