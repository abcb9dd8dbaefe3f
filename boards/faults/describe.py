"""An entry of the fault table in words, and as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rack.backplane.address_map import CLOCK
from rack.backplane.checked import as_named, as_whole, pick
from rack.backplane.fault_table import NEVER, FaultEntry, Stage
from rack.backplane.layout import Layout
from rack.boards.faults.kind import kind_of

ALL_JOINTS = "all joints"


def board_of(entry: FaultEntry, layout: Layout) -> str:
    """Return the task that a fault strikes; "clock" for the clock."""
    return CLOCK if (at := entry.task) < 0 else pick(layout.processes, at, "task").name


def subject_of(entry: FaultEntry, layout: Layout, joints: Sequence[str]) -> str:
    """Return the mailbox or the joint that a fault affects; empty if it affects its task alone."""
    if entry.mailbox >= 0:
        return pick(layout.mailboxes, entry.mailbox, "mailbox").name
    joint = kind_of(entry).values(entry).get("joint")
    return "" if joint is None else joint_name(as_whole(joint), joints)


def joint_name(at: int, joints: Sequence[str]) -> str:
    """Return the name of a joint by its index; -1 is all joints."""
    if at < 0:
        return ALL_JOINTS
    return joints[at] if at < len(joints) else f"joint {at}"


def document(entry: FaultEntry, layout: Layout, joints: Sequence[str]) -> dict[str, Any]:
    """Return an entry as plain data. Unknown ticks are -1, an unknown `until` is None."""
    kind = kind_of(entry)
    stage = as_named(Stage, entry.stage)
    until = None
    if stage in (Stage.ACTIVE, Stage.OVER) and entry.until != NEVER:
        until = entry.until
    return {
        "fault": entry.index,
        "kind": kind.name,
        "board": board_of(entry, layout),
        "mailbox": subject_of(entry, layout, joints) if entry.mailbox >= 0 else "",
        "parameters": kind.values(entry),
        "text": describe(entry, layout, joints),
        "stage": stage.name.lower(),
        "begins": entry.tick,
        "until": until,
        "ticks": entry.ticks,
        "struck_tick": entry.struck_tick,
        "acted": entry.count,
    }


def describe(
    entry: FaultEntry, layout: Layout, joints: Sequence[str], with_board: bool = True
) -> str:
    """Return a fault as one line: its kind, board and parameters."""
    kind = kind_of(entry)
    target = f" of {board_of(entry, layout)}" if with_board else ""
    about = [subject_of(entry, layout, joints)]
    for parameter, value in zip(kind.parameters, entry.parameters, strict=False):
        if parameter.name != "joint":
            unit = "" if parameter.unit in ("1", parameter.name) else f" {parameter.unit}"
            about.append(f"{parameter.name} {value:g}{unit}")
    details = ", ".join(text for text in about if text)
    return f"{kind.name}{target}" + f" ({details})" * bool(details)
