"""The state of a rack at its end, before its memory is released: its faults, its levels, its
arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rack.backplane.checked import as_whole
from rack.backplane.fault_table import FaultEntry, FaultTable, Injection, Stage
from rack.backplane.layout import Layout
from rack.backplane.segment import Segment
from rack.boards.events import arm_states, statuses
from rack.boards.faults.bounds import struck_mailboxes
from rack.boards.faults.describe import board_of
from rack.boards.faults.kind import KINDS, Kind, kind_of
from rack.tools.console.answer import Failure

EXTERNAL = "external kill"
"""The kind, in reports, of a SIGKILL that a campaign itself sends, without the fault table."""

AT_REST = 0.02
"""Joint velocity below which an arm is at rest, rad/s."""


def record_of(kind: str) -> Kind:
    """Return the record of a kind in reports; a kill from outside is like any other. Raises
    `Failure` for an unknown kind.
    """
    name = "kill" if kind == EXTERNAL else kind
    if name not in KINDS:
        why = "no level that is imported here adds it, and the run has no published.json that does"
        raise Failure(f"a fault is of the unknown kind '{kind}': {why}; run the rack again", 2)
    return KINDS[name]


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
    def first(self) -> int:
        """The tick at which it first acted; at which it began, if it never did."""
        return self.tick if self.tick >= 0 else self.began

    @property
    def affected(self) -> tuple[str, ...]:
        """The mailboxes whose messages it affects."""
        return self.mailboxes if self.record.takes_mailbox else ()

    @property
    def record(self) -> Kind:
        """The kind's record."""
        return record_of(self.kind)


@dataclass(frozen=True)
class ArmEnd:
    """An arm at the end of a run: limits violated and touches, counted at every substep; whether it
    is at rest.
    """

    violations: int = 0
    touches: int = 0
    is_at_rest: bool = True


def strikes(segment: Segment, joints: Sequence[str]) -> tuple[Strike, ...]:
    """Return everything injected into a rack, in the order of the fault table."""
    entries = FaultTable(segment).entries
    return tuple(
        _strike(entry, segment.layout, joints) for entry in entries if entry.stage != Stage.FREE
    )


def arm_of(segment: Segment) -> ArmEnd:
    """Return the arm of a rack as its state and its levels last told; a rack without one violates
    no limit.
    """
    seen = [status for _, status in statuses(segment, "violations")]
    counted = [*seen, *(state for _, state in arm_states(segment))]
    return ArmEnd(
        violations=max((arm.violations for arm in counted), default=0),
        touches=max((arm.touches for arm in counted), default=0),
        is_at_rest=all(np.abs(arm.velocity).max() < AT_REST for arm in seen),
    )


def _strike(entry: FaultEntry, layout: Layout, joints: Sequence[str]) -> Strike:
    kind = kind_of(entry)
    values = kind.values(entry)
    board = board_of(entry, layout)
    began = -1 if entry.stage == Stage.WAITING else entry.tick
    joint = as_whole(values.get("joint", -1))
    joint_name = joints[joint] if 0 <= joint < len(joints) else ""
    return Strike(
        fault=entry.index,
        kind=kind.name,
        board=board,
        began=began,
        ends=entry.until,
        tick=entry.struck_tick,
        time_ns=entry.struck_ns,
        count=entry.count,
        hidden=entry.hidden,
        mailboxes=tuple(box.name for box in struck_mailboxes(layout, entry.mailbox, board)),
        joint=joint_name,
        size=values.get("size"),
        injection=Injection(
            kind=entry.kind,
            task=entry.task,
            mailbox=entry.mailbox,
            ticks=entry.ticks,
            phase=entry.phase,
            seed=entry.seed,
            parameters=tuple(values.values()),
        ),
    )
