"""Entries of the fault table as text and as plain data."""

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
    """Return the name of the task that a fault affects, or "clock"."""
    return (
        CLOCK if (task_index := entry.task) < 0 else pick(layout.processes, task_index, "task").name
    )


def subject_of(entry: FaultEntry, layout: Layout, joints: Sequence[str]) -> str:
    """Return the mailbox or the joint that a fault affects.

    Args:
        entry: The fault.
        layout: Layout of the rack.
        joints: Names of the joints.

    Returns:
        An empty string if the fault affects its whole task.
    """
    if entry.mailbox >= 0:
        return pick(layout.mailboxes, entry.mailbox, "mailbox").name
    joint = kind_of(entry).values(entry).get("joint")
    return "" if joint is None else joint_name(as_whole(joint), joints)


def joint_name(at: int, joints: Sequence[str]) -> str:
    """Return the name of a joint by its index. -1 stands for all joints."""
    if at < 0:
        return ALL_JOINTS
    return joints[at] if at < len(joints) else f"joint {at}"


def document(entry: FaultEntry, layout: Layout, joints: Sequence[str]) -> dict[str, Any]:
    """Return an entry of the fault table as plain data.

    Args:
        entry: The fault.
        layout: Layout of the rack.
        joints: Names of the joints.

    Returns:
        A JSON document. Ticks that are not known are -1; `until` is None if the end is not known.
    """
    kind = kind_of(entry)
    stage = as_named(Stage, entry.stage)
    until_tick = None
    if stage in (Stage.ACTIVE, Stage.OVER) and entry.until != NEVER:
        until_tick = entry.until
    return {
        "fault": entry.index,
        "kind": kind.name,
        "board": board_of(entry, layout),
        "mailbox": subject_of(entry, layout, joints) if entry.mailbox >= 0 else "",
        "parameters": kind.values(entry),
        "text": describe(entry, layout, joints),
        "stage": stage.name.lower(),
        "begins": entry.tick,
        "until": until_tick,
        "ticks": entry.ticks,
        "struck_tick": entry.struck_tick,
        "acted": entry.count,
    }


def describe(
    entry: FaultEntry, layout: Layout, joints: Sequence[str], with_board: bool = True
) -> str:
    """Describe a fault in one line.

    Args:
        entry: The fault.
        layout: Layout of the rack.
        joints: Names of the joints.
        with_board: Whether the line names the affected task.

    Returns:
        Kind, task, mailbox or joint, and parameters.
    """
    kind = kind_of(entry)
    target = f" of {board_of(entry, layout)}" if with_board else ""
    details = [subject_of(entry, layout, joints)]
    for parameter, value in zip(kind.parameters, entry.parameters, strict=False):
        if parameter.name != "joint":
            unit = "" if parameter.unit in ("1", parameter.name) else f" {parameter.unit}"
            details.append(f"{parameter.name} {value:g}{unit}")
    detail_text = ", ".join(text for text in details if text)
    return f"{kind.name}{target}" + f" ({detail_text})" * bool(detail_text)
