"""Conversion between actions of a task program and fields of a message."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import TypeAdapter

from rack.levels.errors import ProgramError
from rack.levels.level import LevelContext
from rack.levels.operator import Goal
from rack.levels.systems.coordination.messages import CellAction, OrderAction
from rack.levels.tables import read_program
from rack.levels.task.program import DOWN, AnyAction, Goto, Home, Transfer, find_mismatches

_ACTION: TypeAdapter[AnyAction] = TypeAdapter(AnyAction)


def write_action(action: AnyAction, message: CellAction) -> None:
    """Write an action into a `CellAction`. Fields that it does not need are set to 0."""
    for field in CellAction.message_type.fields:
        message.record[field.name] = np.zeros((), message.record.dtype[field.name])
    message.by = action.by or 0.0
    if isinstance(action, Transfer):
        message.action = OrderAction.TRANSFER
        message.object = action.object
        message.position[:] = action.to
        message.turned = action.yaw is not None
        message.yaw = action.yaw or 0.0
        message.lift = action.lift
    elif isinstance(action, Goto):
        message.action = OrderAction.GOTO
        if action.joints is not None:
            message.goal = Goal.JOINTS
            message.count = len(action.joints)
            message.joints[: message.count] = action.joints
            return
        message.position[:] = action.position
        if action.quaternion is not None:
            message.goal = Goal.POSE
            message.quaternion[:] = action.quaternion
        else:
            message.goal = Goal.DIRECTION
            message.direction[:] = action.direction or DOWN
    elif isinstance(action, Home):
        message.action = OrderAction.HOME


def copy_action(source: CellAction, target: CellAction) -> None:
    """Copy the `CellAction` of one message to another."""
    for field in CellAction.message_type.fields:
        target.record[field.name] = source.record[field.name]


def read_action(message: CellAction, context: LevelContext) -> AnyAction:
    """Return the action in the `CellAction` of a message.

    Raises:
        ProgramError: The action is malformed, or does not suit the arm or the scene.
    """
    return read_program(
        _ACTION.validate_python,
        {**_to_table(message), "by": message.by or None},
        lambda action: find_mismatches(action, context.robot, context.scene),
    )


def _to_table(message: CellAction) -> dict[str, Any]:
    """Convert the action of a message to a table as in a program, without the key `by`.

    Raises:
        ProgramError: The action or the form of its goal is unknown.
    """
    position = message.position.tolist()
    match message.action, message.goal:
        case OrderAction.HOME, _:
            return {"do": "home"}
        case OrderAction.TRANSFER, _:
            yaw = message.yaw if message.turned else None
            return {
                "do": "transfer",
                "object": message.object,
                "to": position,
                "lift": message.lift,
                "yaw": yaw,
            }
        case OrderAction.GOTO, Goal.JOINTS:
            return {"do": "goto", "joints": message.joints[: message.count].tolist()}
        case OrderAction.GOTO, Goal.POSE:
            return {"do": "goto", "position": position, "quaternion": message.quaternion.tolist()}
        case OrderAction.GOTO, Goal.DIRECTION:
            return {"do": "goto", "position": position, "direction": message.direction.tolist()}
    raise ProgramError(
        f"action {message.action} with goal {message.goal} is not known; permitted: transfer, goto,"
        " home"
    )
