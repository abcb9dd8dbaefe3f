"""State of a rack at the end of its run, read before its memory is released."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rack.backplane.checked import to_integer
from rack.backplane.fault_table import FaultEntry, FaultTable, Injection, Stage
from rack.backplane.layout import Layout
from rack.backplane.segment import Segment
from rack.boards.events import iterate_arm_states, iterate_statuses
from rack.boards.faults.bounds import list_affected_mailboxes
from rack.boards.faults.describe import find_board
from rack.boards.faults.kind import KINDS, Kind, find_kind
from rack.tools.console.answer import Failure

EXTERNAL = "external kill"
"""Name, in reports, of a SIGKILL that a campaign sends directly, without the fault table."""

REST_VELOCITY = 0.02
"""Joint velocity in rad/s below which an arm counts as at rest."""


def find_record(kind: str) -> Kind:
    """Return the fault kind with this name in a report. `EXTERNAL` stands for `kill`.

    Raises:
        Failure: The kind is unknown.
    """
    name = "kill" if kind == EXTERNAL else kind
    if name not in KINDS.names:
        why = "no level that is imported here adds it, and the run has no published.json that does"
        raise Failure(f"a fault is of the unknown kind '{kind}': {why}; run the rack again", 2)
    return KINDS[name]


@dataclass(frozen=True)
class Strike:
    """A fault as recorded in the fault table at the end of the run.

    Attributes:
        fault: Index in the fault table.
        kind: Name of the kind.
        board: Affected task.
        began: Tick at which the fault began. -1 if it did not begin.
        ends: Tick at which the fault ended or would have ended, or `NEVER`.
        tick: Tick at which the fault first acted, however little. -1 if it did not act.
        time_ns: CLOCK_MONOTONIC of the first action in ns.
        count: How often the fault acted strongly enough to be detectable.
        hidden: Ticks from `tick` to the first detectable action.
        mailboxes: Affected mailboxes.
        joint: Affected joint. Empty for none or all.
        size: Size of the fault, if its kind has one.
        injection: The fault as injected.
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
    def first_tick(self) -> int:
        """Tick at which the fault first acted or, if it never did, at which it began."""
        return self.tick if self.tick >= 0 else self.began

    @property
    def affected_mailboxes(self) -> tuple[str, ...]:
        """Mailboxes whose messages the fault affects. Empty if its kind affects no messages."""
        return self.mailboxes if self.record.takes_mailbox else ()

    @property
    def record(self) -> Kind:
        """Kind of the fault."""
        return find_record(self.kind)


@dataclass(frozen=True)
class ArmEnd:
    """State of an arm at the end of a run.

    Attributes:
        violations: Number of violated limits, checked at every substep.
        touches: Number of unintended contacts, checked at every substep.
        is_at_rest: Whether all joints are at rest.
    """

    violations: int = 0
    touches: int = 0
    is_at_rest: bool = True


def list_strikes(segment: Segment, joints: Sequence[str]) -> tuple[Strike, ...]:
    """Return all faults that were injected into a rack, in the order of the fault table."""
    return tuple(
        build_strike(entry, segment.layout, joints)
        for entry in FaultTable(segment).entries
        if entry.stage != Stage.FREE
    )


def read_arm(segment: Segment) -> ArmEnd:
    """Return the state of a rack's arm from its newest messages.

    For a rack without an arm, there are no violations and `is_at_rest` is True.
    """
    arm_statuses = [status for _, status in iterate_statuses(segment, "violations")]
    all_states = [*arm_statuses, *(state for _, state in iterate_arm_states(segment))]
    return ArmEnd(
        violations=max((arm.violations for arm in all_states), default=0),
        touches=max((arm.touches for arm in all_states), default=0),
        is_at_rest=all(np.abs(arm.velocity).max() < REST_VELOCITY for arm in arm_statuses),
    )


def build_strike(entry: FaultEntry, layout: Layout, joints: Sequence[str]) -> Strike:
    """Convert an entry of the fault table to a `Strike`."""
    kind = find_kind(entry)
    values = kind.read_parameters(entry)
    board = find_board(entry, layout)
    began = -1 if entry.stage == Stage.WAITING else entry.tick
    joint = to_integer(values.get("joint", -1))
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
        mailboxes=tuple(box.name for box in list_affected_mailboxes(layout, entry.mailbox, board)),
        joint=joints[joint] if 0 <= joint < len(joints) else "",
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
