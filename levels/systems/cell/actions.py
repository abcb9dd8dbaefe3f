"""Actions of a task program as fields of a message, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from rack.backplane.message import Message
from rack.levels.errors import ProgramError
from rack.levels.operator import Goal
from rack.levels.systems.cell.messages import ACTION_FIELDS, OrderAction
from rack.levels.tables import RobotConfig, SceneConfig, frozen
from rack.levels.task.program import DOWN, AnyAction, Goto, Home, Transfer, misfits

_ACTION: TypeAdapter[AnyAction] = TypeAdapter(AnyAction)


def write_action(action: AnyAction, message: Message) -> None:
    """Fill the `ACTION_FIELDS` of a message; what the action lacks is zero."""
    for field in ACTION_FIELDS:
        message.record[field.name] = np.zeros((), message.record.dtype[field.name])
    message.by = action.by or 0.0
    if isinstance(action, Transfer):
        message.action = OrderAction.TRANSFER
        message.object = action.object
        message.position = action.to
        message.turned = action.yaw is not None
        message.yaw = action.yaw or 0.0
        message.lift = action.lift
    elif isinstance(action, Goto):
        message.action = OrderAction.GOTO
        _write_goal(action, message)
    elif isinstance(action, Home):
        message.action = OrderAction.HOME


def _write_goal(action: Goto, message: Message) -> None:
    if action.joints is not None:
        message.goal = Goal.JOINTS
        message.count = len(action.joints)
        message.joints[: message.count] = action.joints
    elif action.position is not None:
        message.position = action.position
        message.goal = Goal.POSE if action.quaternion is not None else Goal.DIRECTION
        if action.quaternion is not None:
            message.quaternion = action.quaternion
        else:
            message.direction = action.direction or DOWN


def copy_action(source: Message, target: Message) -> None:
    """Copy the `ACTION_FIELDS` from one message to another."""
    for field in ACTION_FIELDS:
        target.record[field.name] = source.record[field.name]


def read_action(message: Message, robot: RobotConfig, scene: SceneConfig) -> AnyAction:
    """Return the action in the `ACTION_FIELDS` of a message. Raises `ProgramError`: it does not
    suit arm or scene."""
    table = _table(message) | ({"by": message.by} if message.by else {})
    try:
        action: AnyAction = _ACTION.validate_python(frozen(table))
    except ValidationError as error:
        lines = [f"{'.'.join(map(str, entry['loc']))}: {entry['msg']}" for entry in error.errors()]
        raise ProgramError("\n".join(lines)) from error
    if found := [f"{key} = {value!r}: {why}" for key, value, why in misfits(action, robot, scene)]:
        raise ProgramError("\n".join(found))
    return action


def _table(message: Message) -> dict[str, Any]:
    what = message.action
    goal = message.goal
    if what == OrderAction.HOME:
        return {"do": "home"}
    if what == OrderAction.TRANSFER:
        turn = {"yaw": message.yaw} if message.turned else {}
        place = message.position.tolist()
        return {
            "do": "transfer",
            "object": message.object,
            "to": place,
            "lift": message.lift,
            **turn,
        }
    if what != OrderAction.GOTO or goal not in (Goal.JOINTS, Goal.POSE, Goal.DIRECTION):
        raise ProgramError(
            f"action {what} with goal {goal} is not known; permitted: transfer, goto, home"
        )
    if goal == Goal.JOINTS:
        return {"do": "goto", "joints": message.joints[: message.count].tolist()}
    turned = "quaternion" if goal == Goal.POSE else "direction"
    return {
        "do": "goto",
        "position": message.position.tolist(),
        turned: getattr(message, turned).tolist(),
    }
