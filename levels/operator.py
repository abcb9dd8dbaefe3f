"""What an operator may tell any level, beside or instead of the level above it: the words and the messages of it.

A level that can be commanded reads "own.operator", says in `commands` what it takes, follows it with
`rack.levels.orders`, and has `ANSWER` among the fields of its status. `RESTS_ON` goes down with every command, so that
the lowest status tells which command of an operator its torque rests on: the response of the system is measured, not
guessed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum

from rack.backplane.message import REASON_BYTES, Field, command

MOST_JOINTS = 16
"""Joints of an arm, at most: an operator's mailbox is the same in every rack."""


class What(IntEnum):
    """What an operator says."""

    NONE = 0
    HOLD = 1  # come to rest, and stay until RESUME
    RESUME = 2  # go on with your own work
    SETPOINT = 3  # bring the joints to positions, and stay until RESUME
    GOTO = 4  # move to a goal by your own planning, and stay until RESUME


class Goal(IntEnum):
    """How the goal of a command is given."""

    NONE = 0
    JOINTS = 1  # joint positions
    POSE = 2  # position and orientation of the tool
    DIRECTION = 3  # position of the tool and direction of its z axis, any turn about it
    HOME = 4  # where the arm starts


class Answer(IntEnum):
    """What has become of an operator's newest command."""

    NONE = 0  # there was none
    TAKEN = 1  # the level does it
    DONE = 2
    REFUSED = 3  # it goes on as before


OPERATOR_COMMAND = command(
    "operator_command",
    1,
    Field("what", "u1", What, "what to do"),
    Field("goal", "u1", Goal, "how the goal is given"),
    Field("count", "u1", "1", "joints that follow"),
    Field("joints", "f8", "rad", "joint positions, for goal joints", (MOST_JOINTS,)),
    Field("position", "f8", "m", "of the tool, for goals pose and direction", (3,)),
    Field("quaternion", "f8", "1", "of the tool, for goal pose", (4,)),
    Field("direction", "f8", "1", "of the tool's z axis, for goal direction", (3,)),
)

RESTS_ON = Field("operator", "u4", "1", "newest command of an operator, here or above, that this rests on; 0: none")
ANSWER = (
    RESTS_ON,
    Field("order", "u4", "1", "newest command that an operator gave to this level; 0: none yet"),
    Field("answer", "u1", Answer, "what has become of it"),
    Field("standing", "u1", What, "what an operator has the level do; 0: its own work"),
    Field("objection", f"S{REASON_BYTES}", "ASCII", "why it was refused, readable"),
)
"""Fields of a status that answer an operator."""

Commands = Mapping[What, Sequence[Goal]]


def listed(commands: Commands) -> str:
    """Return what a level can be told, for people: "hold, resume, goto joints|pose"."""
    return ", ".join(f"{what.name.lower()} {goal_names(goals)}".rstrip() for what, goals in commands.items())


def goal_names(goals: Sequence[Goal]) -> str:
    """Return goals as one word: "joints|pose"."""
    return "|".join(goal.name.lower() for goal in goals)


def told(what: int, goal: int) -> str:
    """Return a command in words, whatever its numbers: "goto pose"."""
    names = [
        kind(number).name.lower() if number in set(kind) else str(number)
        for kind, number in ((What, what), (Goal, goal))
    ]
    return " ".join(names[: 1 + (goal != Goal.NONE)])
