"""Which parts of the view each mailbox and each task feeds; by message types, so that any rack has a view."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

from rack.backplane.layout import Layout, MailboxSpec
from rack.boards.config import RackConfig
from rack.levels.messages import (
    ARM_STATE,
    JOINT_SET_POINT,
    MOVE_PLAN,
    MOVE_STATUS,
    SCENE,
    SERVO_STATUS,
    TASK_PLAN,
    WORLD_MODEL,
)
from rack.levels.robot.cell import Cell
from rack.tools.viewer.activity import Activity, Commanded, Moves
from rack.tools.viewer.blocks import Part
from rack.tools.viewer.fields import Fields
from rack.tools.viewer.joints import Joints
from rack.tools.viewer.poses import Poses
from rack.tools.viewer.stream import Stream
from rack.tools.viewer.ways import CurrentGoal, Goals, PlannedPath

SHOWN_IN_3D = (ARM_STATE.name, SCENE.name, WORLD_MODEL.name)
"""Messages whose numbers nobody reads as curves."""


def parts_of(stream: Stream, layout: Layout, config: RackConfig, cell: Cell | None) -> Mapping[str, list[Part]]:
    """Return the parts by mailbox."""
    parts: dict[str, list[Part]] = defaultdict(list)
    for mailbox in layout.mailboxes:
        parts[mailbox.name] += _of_any(stream, mailbox)
    if cell is not None and config.robot is not None:
        goals = Goals(stream, config.scene.bodies)
        for mailbox in layout.mailboxes:
            parts[mailbox.name] += _of_arm(stream, mailbox, config, cell, goals)
    return parts


def _of_any(stream: Stream, mailbox: MailboxSpec) -> list[Part]:
    names = {field.name for field in mailbox.fields}
    parts: list[Part] = []
    if {"state", "error", "reason"} <= names and mailbox.message != ARM_STATE.name:
        parts.append(Activity(stream, mailbox))
    elif mailbox.name.endswith(".command") and "id" in names and mailbox.message != JOINT_SET_POINT.name:
        parts.append(Commanded(stream, mailbox))
    if mailbox.message == MOVE_STATUS.name:
        parts.append(Moves(stream, mailbox))
    if mailbox.message not in (*SHOWN_IN_3D, SERVO_STATUS.name):
        parts.append(Fields(stream, mailbox))
    return parts


def _of_arm(stream: Stream, mailbox: MailboxSpec, config: RackConfig, cell: Cell, goals: Goals) -> list[Part]:
    robot = config.robot
    assert robot is not None, "there is an arm"
    match mailbox.message:
        case ARM_STATE.name:
            return [Poses(stream, cell, config.clock_ns)]
        case SERVO_STATUS.name:
            return [Joints(stream, robot.joints, cell, robot.gripper is not None)]
        case MOVE_PLAN.name:
            return [PlannedPath(stream, cell)]
        case TASK_PLAN.name:
            return [goals]
        case MOVE_STATUS.name:
            return [CurrentGoal(goals)]
        case _:
            return []
