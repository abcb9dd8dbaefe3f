"""Motion requests, and the status of the level that carries them out.

A planning level or a program queues the requests.
"""

from __future__ import annotations

from enum import IntEnum

from numpy import ndarray

from rack.backplane.message import Message, field, integer_field
from rack.levels.messages import joint_field
from rack.levels.operator import AnsweringStatus, RelayedCommand

MAX_HELD_REQUESTS = 16
"""Number of motion requests that a trajectory level takes from the queue in advance.

A CANCEL is seen at once while no more requests than this are open.
"""
LISTED_ENDED_REQUESTS = 8
"""Number of ended requests that a status lists."""


class MotionKind(IntEnum):
    """Kinds of motion requests."""

    NONE = 0
    JOINTS = 1  # a straight line in joint space, to joint positions
    POSE = 2  # a straight line of the tool, to a pose
    STAY = 3  # stay at the goal before it for `segment`
    # End the request under way and drop all queued before this one. The arm ramps to rest.
    CANCEL = 4
    GRIP = 5  # move the gripper to `opening` with at most `force`, the arm at rest
    # The next two are for a server of force and motion only, see
    # `rack.levels.systems.force.messages`.
    COMPLY = 6
    GUARD = 7
    MEET = (
        8  # wait for another arm, and start with it: see `rack.levels.systems.trajectory.meeting`
    )


class RequestEnd(IntEnum):
    """Outcome of a request."""

    NONE = 0
    DONE = 1
    CANCELLED = 2
    REFUSED = 3  # for the reason in the status
    FAILED = 4  # abandoned while under way
    GUARDED = 5  # ended by its guard


class MotionRequest(RelayedCommand, version=1):
    """A motion for the trajectory level.

    The `id` numbers requests consecutively from 1 in the order of the queue. A request whose id is
    not above the newest one taken is a repetition.
    """

    kind: MotionKind = field(doc="what to do")
    joints: ndarray = joint_field("rad", "goal of JOINTS")
    position: ndarray = field(
        unit="m", doc="goal of POSE: tool position, in the frame of `body`", shape=3
    )
    quaternion: ndarray = field(
        unit="1", doc="goal of POSE: tool orientation, in the frame of `body`", shape=4
    )
    body: int = integer_field(
        "row of the body whose frame the goal refers to (-1: the world)", "i2"
    )
    live: bool = field(
        doc="1 if the goal follows the body, 0 if the frame is fixed at the start of the request"
    )
    acceleration: float = field(
        unit="s", doc="half the blend time into this request (0: default of the level)"
    )
    segment: float = field(
        unit="s", doc="time for the request, stretched if too short (0: set by speed limits)"
    )
    opening: float = field(unit="m", doc="gripper joint position to go to, for GRIP")
    force: float = field(unit="N", doc="largest gripper force, for GRIP")
    touch: float = field(
        unit="N m",
        doc="lasting change of a joint torque at which POSE ends GUARDED (0: no guard)",
    )


class MotionState(Message, version=1):
    """State that a restarted trajectory level needs in addition to its status.

    With both it neither repeats nor loses a request.
    """

    begun: bool = field(doc="1: the first of `requests` is under way")
    passed: float = field(unit="s", doc="time that it has stayed or gripped")
    goal: ndarray = field(
        MotionRequest,
        doc="the request at whose goal the arm is, or to which it goes; id 0: none",
    )
    count: int = integer_field("requests that follow", "u2")
    requests: ndarray = field(
        MotionRequest, doc="taken and not ended, oldest first", shape=MAX_HELD_REQUESTS
    )


class MotionStatus(AnsweringStatus, version=1):
    """Status of a trajectory level."""

    taken: int = integer_field("newest request taken from the queue (0: none yet)")
    current: int = integer_field("request being carried out (0: none)")
    done: int = integer_field("newest request that ended in any way (0: none yet)")
    ended: ndarray = field(
        "u4",
        unit="1",
        doc="ids of the last requests to end, newest first (0: none)",
        shape=LISTED_ENDED_REQUESTS,
    )
    ends: ndarray = field("u1", unit=RequestEnd, doc="how they ended", shape=LISTED_ENDED_REQUESTS)
    progress: float = field(
        unit="1", doc="part of the current request's time that has passed, 0 to 1"
    )
    resting: bool = field(doc="1: commanded velocity is zero")
    position: ndarray = joint_field("rad", "joint positions commanded last")
    velocity: ndarray = joint_field("rad/s", "joint velocities commanded last")
    tool: ndarray = field(unit="m", doc="tool position commanded last", shape=3)
    astray: float = field(
        unit="m", doc="its distance from a live goal that was reached (0: no live goal)"
    )
