"""Messages of the default rack: commands go down, statuses come up, plans stay within a level.

Symbolic sizes are `joints`, `bodies` (objects, then obstacles; at least 1) and `state` (of a
simulated cell, see `rack.levels.robot.engine`). Quaternions are w, x, y, z. Poses are in the world
frame. Simulated time is the tick times the clock's period.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Protocol

from numpy import ndarray

from rack.backplane.message import Message, field, integer_field
from rack.backplane.words import Demand
from rack.levels.operator import AnsweringStatus, RelayedCommand

WINDOW_MOVES = 8
"""Elemental moves in one task command.

With this number, the level below never has to wait for a cycle of the task level.
"""
SEGMENTS = 2
"""Number of segments in one move command."""
WAYPOINTS = 24
"""Maximum number of joint-space points of a path."""
MOVES = 96
"""Maximum number of elemental moves of a task program."""
SECTIONS_PER_LINE = 8
"""Sections of constant jerk for one line of a path and the corner after it.

Seven sections change the speed, and one keeps it.
"""
SECTIONS = SECTIONS_PER_LINE * (WAYPOINTS - 1)
"""Maximum number of sections of constant jerk of a trajectory."""


class Error(IntEnum):
    """Error codes of the levels' statuses."""

    NONE = 0
    UNREACHABLE = 1
    NO_PATH = 2
    TOO_LATE = 3
    GRASP_MISSED = 4
    OBJECT_LOST = 5
    FOLLOWING = 6
    LIMIT = 7
    SIMULATION = 8
    BELOW = 9
    TOUCHED = 10
    SENSORS = 11  # a sensor did not recover within its bound
    BLOCKED = 12  # an obstacle remains after the maximum number of replans
    OVERLOAD = 13  # the load exceeds what motors or gripper can carry
    STALLED = 14  # nothing has moved for the time that the task permits
    MOTORS = 15  # a motor did not produce its torque in any retry
    TABLE = 16  # a state table reached a row with status error
    GIVEN_UP = 17  # another rack made all racks abandon their common program
    FORCE = 18  # a contact exceeded the arm's limits of force
    CLIENT = 19  # a server's client is lost or silent
    CONTACT = 20  # a contact was not made, or was lost
    DISABLED = 21  # the arm is not enabled; its operator has to enable it
    DRIVES = 22  # the arm's drives report a fault; its operator has to reset it


class Verb(IntEnum):
    """Kinds of elemental moves."""

    NONE = 0
    MOVE = 1  # free motion of the tool to a pose
    MOVE_JOINTS = 2  # free motion to joint positions
    APPROACH = 3  # straight motion; the object held or to be grasped may touch its support
    GRASP = 4  # close the gripper on an object
    DEPART = 5  # straight motion away; the same contacts are permitted
    RELEASE = 6  # open the gripper


class SegmentKind(IntEnum):
    """Kinds of segments."""

    NONE = 0
    PATH = 1
    GRIPPER = 2


def joint_field(unit: str, doc: str) -> Any:
    """Declare a field with one number for each joint of the arm."""
    return field(unit=unit, doc=doc, shape="joints")


class ElementalMove(Message, version=1):
    """One elemental move of a program."""

    id: int = integer_field("serial of the move, rising by one from 1 (0: empty)")
    action: int = integer_field("index of the program's action that it serves", "u2")
    verb: Verb = field(doc="what to do")
    object: int = integer_field("row of the object concerned in the world model (-1: none)", "i2")
    position: ndarray = field(unit="m", doc="tool position at the end", shape=3)
    quaternion: ndarray = field(unit="1", doc="tool orientation at the end", shape=4)
    joints: ndarray = joint_field("rad", "where MOVE_JOINTS ends; with `posture`, near the end")
    posture: bool = field(doc="1: select the configuration nearest to `joints` at the pose")
    by: float = field(unit="s", doc="simulated time by which it must be done (0: any time)")


class TaskPlan(Message, version=1):
    """The task level's plan, from planner to executor: the program as elemental moves."""

    id: int = integer_field("serial of the plan")
    error: Error = field("u2", doc="why the program is refused (0: not refused)")
    reason: str = field(doc="the refusal, readable")
    earliest: float = field(
        unit="s", doc="with TOO_LATE: the earliest time at which it could be done"
    )
    count: int = integer_field("moves that follow", "u2")
    moves: ndarray = field(ElementalMove, doc="the program, decomposed", shape=MOVES)


class TaskCommand(RelayedCommand, version=2):
    """Command from the task level to the elemental move level: the next moves of the plan."""

    hold: bool = field(doc="1: ramp to rest and stay, whatever is under way")
    count: int = integer_field("moves that follow; id is the newest one's", "u2")
    moves: ndarray = field(
        ElementalMove, doc="a window on the plan, oldest first", shape=WINDOW_MOVES
    )


class TaskStatus(AnsweringStatus, version=2):
    """Status of the task level."""

    action: int = integer_field("actions done", "u2")
    actions: int = integer_field("actions of the program", "u2")
    moves_done: int = integer_field("elemental moves done", "u2")
    moves: int = integer_field("elemental moves of the plan; 0 before there is one", "u2")
    first: int = integer_field("id under which the plan's first move is handed down")
    detour: int = integer_field("id of the move that an operator requested instead (0: none)")


OPERATED = field(doc="1: an operator keeps this level, or one below it, from its normal work")


class MoveStatus(AnsweringStatus, version=3):
    """Status of the elemental move level."""

    done: int = integer_field("newest elemental move done (0: none yet)")
    current: int = integer_field("elemental move under way (0: none)")
    progress: float = field(unit="1", doc="part of its path done, 0 to 1")
    verb: Verb = field(doc="of the move under way")
    held: int = integer_field("row of the object in the gripper (-1: none)", "i2")
    planned: int = integer_field("newest elemental move whose path is ready (0: none yet)")
    end: ndarray = joint_field("rad", "joint positions at the end of that path")
    replan: int = integer_field("open request to replan the current move from `start` (0: none)")
    start: ndarray = joint_field("rad", "joint positions where that motion holds")
    replans: int = integer_field("number of replans because of an obstacle")
    operated: bool = OPERATED
    resting: bool = field(
        doc="1: the arm rests, and the level that moves it has the operator's newest command"
    )


class MovePlan(Message, version=1):
    """The elemental move level's plan, from planner to executor: a path for one move."""

    move: int = integer_field("elemental move that the plan serves")
    replan: int = integer_field("request that it answers (0: the first plan of the move)")
    error: Error = field("u2", doc="why there is no plan (0: there is a plan)")
    reason: str = field(doc="the error, readable")
    kind: SegmentKind = field(doc="path or gripper")
    count: int = integer_field("waypoints that follow", "u2")
    waypoints: ndarray = field(
        unit="rad", doc="collision-free path in joint space", shape=(WAYPOINTS, "joints")
    )
    blend: ndarray = field(
        unit="rad",
        doc="length over which corner k is rounded, before and after it",
        shape=WAYPOINTS,
    )


class MoveSegment(Message, version=1, message="segment"):
    """One segment of a move: a path, or a motion of the gripper."""

    id: int = integer_field("serial of the segment, rising by one from 1 (0: empty)")
    move: int = integer_field("elemental move that it serves")
    kind: SegmentKind = field(doc="path or gripper")
    object: int = integer_field("object held, or to be grasped (-1: none)", "i2")
    touch: bool = field(doc="1: the object may touch supports and fingers (approach, depart)")
    count: int = integer_field("waypoints that follow", "u2")
    waypoints: ndarray = field(
        unit="rad",
        doc="path in joint space, from where the motion starts",
        shape=(WAYPOINTS, "joints"),
    )
    blend: ndarray = field(unit="rad", doc="length over which corner k is rounded", shape=WAYPOINTS)
    by: float = field(unit="s", doc="simulated time by which it must be done (0: any time)")
    opening: float = field(unit="m or rad", doc="gripper joint position to go to, for GRIPPER")
    force: float = field(unit="N or N m", doc="largest gripper force on the way and afterwards")


class MoveCommand(RelayedCommand, version=2):
    """Command from the elemental move level to the primitive level: the next segments."""

    hold: bool = field(doc="1: ramp to rest on the path and stay")
    count: int = integer_field("segments that follow; id is the newest one's", "u2")
    segments: ndarray = field(MoveSegment, doc="segments to do, oldest first", shape=SEGMENTS)


class PrimitiveStatus(AnsweringStatus, version=3):
    """Status of the primitive level."""

    done: int = integer_field("newest segment done (0: none yet)")
    current: int = integer_field("segment under way (0: none)")
    progress: float = field(unit="1", doc="part of the segment's path done, 0 to 1")
    blocked: bool = field(doc="1: motion holds because of an obstacle")
    resting: bool = field(doc="1: commanded velocity is zero")
    operated: bool = OPERATED
    held: int = integer_field("row of the object in the gripper (-1: none)", "i2")
    opening: float = field(unit="m or rad", doc="gripper joint position, measured")
    position: ndarray = joint_field("rad", "joint positions commanded last")
    earliest: float = field(
        unit="s", doc="with TOO_LATE: the earliest time at which it could be done"
    )
    ends: float = field(
        unit="s", doc="simulated time at which the segment under way should be done (0: not known)"
    )
    wants: int = integer_field("segment for which the planner is to compute a trajectory (0: none)")
    begin: float = field(
        unit="rad", doc="path parameter at which that trajectory is to begin, from rest"
    )


class TrajectoryPlan(Message, version=1, message="trajectory"):
    """The primitive level's plan, from planner to executor: the timing of a path."""

    segment: int = integer_field("segment that it serves")
    error: Error = field("u2", doc="why there is no trajectory (0: there is one)")
    reason: str = field(doc="the error, readable")
    begin: float = field(unit="rad", doc="path parameter at which it begins")
    duration: float = field(unit="s", doc="from rest to rest")
    earliest: float = field(
        unit="s", doc="simulated time at which the segment could be done at the earliest"
    )
    count: int = integer_field("sections that follow", "u2")
    sections: ndarray = field(
        unit="s, 1, 1/s, 1/s2, 1/s3",
        doc="start, s, ds, dds, jerk of the path parameter",
        shape=(SECTIONS, 5),
    )


class JointCommand(RelayedCommand, version=2, message="joint_set_point"):
    """Command from the primitive level to the servo level: a joint set point and its due tick."""

    due: int = field(
        unit="tick", doc="tick at which the set point applies (0: no set point yet, hold)"
    )
    position: ndarray = joint_field("rad", "joint positions")
    velocity: ndarray = joint_field("rad/s", "joint velocities")
    acceleration: ndarray = joint_field("rad/s2", "joint accelerations")
    opening: float = field(unit="m or rad", doc="gripper joint position to go to")
    force: float = field(unit="N or N m", doc="largest gripper force")
    held: int = integer_field("row of the object in the gripper (-1: none)", "i2")


class ArmSetPoint(Protocol):
    """Fields that the servo level reads from a set point message, such as `JointCommand`."""

    due: int
    position: ndarray
    velocity: ndarray
    opening: float
    force: float


class ServoPlan(Message, version=1):
    """The servo level's plan, from planner to executor: the inertia of arm and load."""

    inertia: ndarray = field(
        unit="kg m2",
        doc="joint-space inertia, the object held included",
        shape=("joints", "joints"),
    )
    held: int = integer_field("object included (-1: none)", "i2")
    payload_mass: float = field(unit="kg", doc="mass in the gripper")
    payload_offset: ndarray = field(unit="m", doc="its centre, in the frame of the tool", shape=3)


class DrivenArm(AnsweringStatus):
    """Base class for the status of a level that drives an arm."""

    position: ndarray = joint_field(
        "rad", "joint positions, measured; estimated for suspect sensors"
    )
    velocity: ndarray = joint_field("rad/s", "joint velocities, likewise")
    torque: ndarray = joint_field(
        "N m", "torque given to the arm in this cycle, after the limit gate"
    )
    target: ndarray = joint_field("rad", "set point of the joints in this cycle")
    target_velocity: ndarray = joint_field("rad/s", "likewise")
    opening: float = field(unit="m or rad", doc="gripper joint position, measured")
    opening_velocity: float = field(unit="m/s or rad/s", doc="gripper joint velocity, measured")
    grip_force: float = field(unit="N or N m", doc="force given to the gripper")
    holding: bool = field(doc="1: no fresh set point, the arm ramps to rest and stays")
    stopped: bool = field(
        doc="1: set points are not followed: a demand, an operator, a fault, or brakes"
    )
    braked: bool = field(doc="1: the brakes are engaged")
    demand: Demand = field(doc="stop that the rack's safety demands in this cycle")
    clipped: int = integer_field("cycles in which the limit gate cut a torque or a set point")
    touches: int = integer_field("unintended contacts, counted at every substep")
    violations: int = integer_field(
        "substeps in which the arm drove a position, velocity or torque beyond its limit"
    )
    pushed: int = integer_field("substeps in which a blow pushed a joint beyond a limit")
    slowed: bool = field(doc="1: speeds are scaled down by robot.bring_up, until the release of it")


class ServoStatus(DrivenArm, version=5):
    """Status of the servo level."""


class ArmState(Message, version=3):
    """State of the arm, from which a restarted board continues."""

    tick: int = field(unit="tick", doc="tick that the state belongs to")
    clipped: int = integer_field("cycles in which the limit gate cut a command")
    touches: int = integer_field("unintended contacts")
    violations: int = integer_field("substeps in which the arm broke a limit")
    pushed: int = integer_field("substeps in which a blow pushed a joint beyond a limit")
    struck: int = field(
        "i4", unit="tick", doc="ticks for which the motion is still attributed to a blow"
    )
    waited: int = field("i4", unit="tick", doc="ticks since the last command")
    braked: bool = field(doc="1: the brakes are engaged")
    rest: ndarray = joint_field("rad", "where engaged brakes hold the joints")
    position: ndarray = joint_field("rad", "joint positions as the servo level estimates them")
    velocity: ndarray = joint_field("rad/s", "joint velocities, likewise")
    doubt: ndarray = joint_field("rad", "largest error of those positions")
    kept: int = field(
        unit="tick",
        doc="ticks for which faults have kept the arm from its set points: see ArmParams.patience",
    )
    error: Error = field("u2", doc="latched fault (0: none)")
    reason: str = field(doc="that fault, readable")
    state: ndarray = field(
        unit="", doc="of the simulated cell, see rack.levels.robot.engine", shape="state"
    )


class Scene(Message, version=1):
    """Sensed poses of bodies and tool."""

    position: ndarray = field(unit="m", doc="body origins as sensed", shape=("bodies", 3))
    quaternion: ndarray = field(unit="1", doc="body orientations as sensed", shape=("bodies", 4))
    tool_position: ndarray = field(unit="m", doc="tool as sensed", shape=3)
    tool_quaternion: ndarray = field(unit="1", doc="tool as sensed", shape=4)


class WorldState(Message, version=1, message="world_model"):
    """Poses of bodies in the world model."""

    revision: int = integer_field(
        "rises when a body starts to move and when it rests again (0: nothing sensed)"
    )
    position: ndarray = field(unit="m", doc="body origins", shape=("bodies", 3))
    quaternion: ndarray = field(unit="1", doc="body orientations", shape=("bodies", 4))
    velocity: ndarray = field(unit="m/s", doc="body velocities, estimated", shape=("bodies", 3))
    sensed: int = field(unit="tick", doc="cycle in which the newest scene was taken over")
