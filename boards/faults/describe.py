"""Entries of the fault table as text and as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rack.backplane.address_map import CLOCK
from rack.backplane.checked import select_item, to_enum, to_integer
from rack.backplane.fault_table import NEVER, FaultEntry, Stage
from rack.backplane.layout import Layout
from rack.boards.faults.kind import find_kind
from rack.boards.faults.message_steps import describe_wrong_value

ALL_JOINTS = "all joints"


def find_board(entry: FaultEntry, layout: Layout) -> str:
    """Return the name of the task that a fault affects, or "clock"."""
    return CLOCK if entry.task < 0 else select_item(layout.processes, entry.task, "task").name


def find_subject(entry: FaultEntry, layout: Layout, joints: Sequence[str]) -> str:
    """Return the name of the mailbox or joint that a fault affects.

    Args:
        entry: The fault.
        layout: Layout of the rack.
        joints: Names of the joints.

    Returns:
        The name of the mailbox or joint. Empty if the fault affects its whole task.
    """
    if entry.mailbox >= 0:
        return select_item(layout.mailboxes, entry.mailbox, "mailbox").name
    joint = find_kind(entry).read_parameters(entry).get("joint")
    return "" if joint is None else format_joint(to_integer(joint), joints)


def format_joint(index: int, joints: Sequence[str]) -> str:
    """Return the name of the joint with this index. -1 stands for all joints."""
    if index < 0:
        return ALL_JOINTS
    return joints[index] if index < len(joints) else f"joint {index}"


def to_document(entry: FaultEntry, layout: Layout, joints: Sequence[str]) -> dict[str, Any]:
    """Return an entry of the fault table as plain data.

    Args:
        entry: The fault.
        layout: Layout of the rack.
        joints: Names of the joints.

    Returns:
        A JSON document. Ticks that are not known are -1; `until` is None if the end is not known.
    """
    kind = find_kind(entry)
    stage = to_enum(Stage, entry.stage)
    has_end = stage in (Stage.ACTIVE, Stage.OVER) and entry.until != NEVER
    return {
        "fault": entry.index,
        "kind": kind.name,
        "board": find_board(entry, layout),
        "mailbox": find_subject(entry, layout, joints) if entry.mailbox >= 0 else "",
        "parameters": kind.read_parameters(entry),
        "text": describe_fault(entry, layout, joints),
        "stage": stage.name.lower(),
        "begins": entry.tick,
        "until": entry.until if has_end else None,
        "ticks": entry.ticks,
        "struck_tick": entry.struck_tick,
        "acted": entry.count,
    }


def describe_fault(
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
    kind = find_kind(entry)
    target = f" of {find_board(entry, layout)}" if with_board else ""
    details = [find_subject(entry, layout, joints)]
    if kind.where == "copy":
        # Name the field and the bit, which may be drawn.
        spec = select_item(layout.mailboxes, entry.mailbox, "mailbox")
        details[0] += f".{describe_wrong_value(entry, spec)}"
    else:
        for parameter, value in zip(kind.parameters, entry.parameters, strict=False):
            if parameter.name != "joint":
                unit = "" if parameter.unit in ("1", parameter.name) else f" {parameter.unit}"
                details.append(f"{parameter.name} {value:g}{unit}")
    detail_text = ", ".join(text for text in details if text)
    return f"{kind.name}{target}" + f" ({detail_text})" * bool(detail_text)
