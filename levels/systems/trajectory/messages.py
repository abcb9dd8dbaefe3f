"""Motion requests, which a planning level or a program queues, and the status of the level that
does them."""

from __future__ import annotations

from enum import IntEnum

from rack.backplane.message import Field, MessageType, command, status
from rack.levels.fields import by_joint, flag, number, real, row, short_count
from rack.levels.operator import ANSWER, RESTS_ON

HELD = 16
"""Motion requests that a trajectory level takes ahead: a CANCEL is seen at once while no more than
these are open."""
ENDED = 8
"""Ended requests that a status lists."""


class MotionKind(IntEnum):
    """Kinds of motion requests."""

    NONE = 0
    JOINTS = 1  # a straight line in joint space, to joint positions
    POSE = 2  # a straight line of the tool, to a pose
    STAY = 3  # stay at the goal before it for `segment`
    CANCEL = (
        4  # end the request under way and drop all queued before this one; the arm ramps to rest
    )
    GRIP = 5  # bring the gripper to `opening` with at most `force`, at rest
    # of a server of force and motion alone, like GUARD: see `rack.levels.systems.force.messages`
    COMPLY = 6
    GUARD = 7


class RequestEnd(IntEnum):
    """How a request ended."""

    NONE = 0
    DONE = 1
    CANCELLED = 2
    REFUSED = 3  # see the status' reason
    FAILED = 4  # given up on the way
    GUARDED = 5  # a guard was struck on the way


MOTION_REQUEST = command(
    "motion_request",
    1,
    RESTS_ON,
    Field("kind", "u1", MotionKind, "what to do"),
    by_joint("joints", "rad", "goal of JOINTS"),
    real("position", "m", "goal of POSE: tool position, in the frame of `body`", 3),
    real("quaternion", "1", "goal of POSE: tool orientation, in the frame of `body`", 4),
    row("body", "row of the body in the world model in whose frame the goal is; -1: the world"),
    flag("live", "1: the goal follows the body; 0: its frame is copied when the request begins"),
    real(
        "acceleration", "s", "half the time of the blend into this request; 0: the level's default"
    ),
    real("segment", "s", "time for the request; 0: from the speed limits; too short: stretched"),
    real("opening", "m", "gripper joint position to go to, for GRIP"),
    real("force", "N", "largest gripper force, for GRIP"),
    real(
        "touch",
        "N m",
        "lasting change of any joint's torque at which POSE ends GUARDED; 0: no guard",
    ),
)
"""`id` numbers requests, rising by one from 1 in the order of the queue; one not above those taken
is a repetition."""


def state_of(name: str, request: MessageType) -> MessageType:
    """Return the type of what a restarted level needs, with its status, to neither repeat nor lose
    a request."""
    return MessageType(
        name,
        1,
        (
            flag("begun", "1: the first of `requests` is under way"),
            real("passed", "s", "time that it has stayed or gripped"),
            Field(
                "goal",
                request,
                "",
                "the request at whose goal the arm is, or to which it goes; id 0: none",
            ),
            short_count("count", "requests that follow"),
            Field("requests", request, "", "taken and not ended, oldest first", (HELD,)),
        ),
    )


MOTION_STATE = state_of("motion_state", MOTION_REQUEST)
"""Of a trajectory level."""

MOTION_STATUS = status(
    "motion_status",
    1,
    *ANSWER,
    number("taken", "newest request taken from the queue; 0: none yet"),
    number("current", "request under way; 0: none"),
    number("done", "newest request ended, however; 0: none yet"),
    Field("ended", "u4", "1", "ids of the last requests ended, newest first; 0: none", (ENDED,)),
    Field("ends", "u1", RequestEnd, "how they ended", (ENDED,)),
    real("progress", "1", "part of the current request's time that has passed, 0 to 1"),
    flag("resting", "1: commanded velocity is zero"),
    by_joint("position", "rad", "joint positions commanded last"),
    by_joint("velocity", "rad/s", "joint velocities commanded last"),
    real("tool", "m", "tool position commanded last", 3),
    real("astray", "m", "distance of that from a live goal, once reached; 0: there is none"),
)
