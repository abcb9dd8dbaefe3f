"""The messages of the default rack: commands go down, statuses come up, plans stay within a level.

Symbolic sizes: `joints`, `bodies` (objects, then obstacles; at least 1) and `state` (of a simulated
cell, see `rack.levels.robot.state`). Quaternions are w, x, y, z. Poses are in the world frame.
Simulated time is tick times the clock's period.
"""

from __future__ import annotations

from enum import IntEnum

from rack.backplane.message import Field, MessageType, command, status
from rack.backplane.words import Demand
from rack.levels.fields import by_joint, flag, number, real, row, short_count, tick
from rack.levels.operator import ANSWER, RESTS_ON

WINDOW = 8
"""Elemental moves in one task command: the level below never waits for a cycle of the task
level."""
SEGMENTS = 2
"""Segments in one move command."""
WAYPOINTS = 24
"""Most joint-space points of one path."""
MOVES = 96
"""Most elemental moves of one task program."""
SECTIONS_A_LINE = 8
"""Sections of constant jerk for one line of a path and the corner after it: seven change speed, one
keeps it."""
SECTIONS = SECTIONS_A_LINE * (WAYPOINTS - 1)
"""Most sections of constant jerk of one trajectory."""


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
    BLOCKED = 12  # something stays in the way, after as many replans as permitted
    OVERLOAD = 13  # more than motors or gripper can carry
    STALLED = 14  # nothing has moved for the time that the task permits
    MOTORS = 15  # a motor did not give its torque, however often it was retried
    TABLE = 16  # a state table came to a row with status error
    GIVEN_UP = 17  # the program of several racks was given up, for a reason in another one
    FORCE = 18  # a contact stronger than the arm's limits
    CLIENT = 19  # a server's client is lost or silent
    CONTACT = 20  # a contact was not made, or was lost
    DISABLED = 21  # the arm is not enabled yet, or no more: its operator enables it
    DRIVES = 22  # the arm's drives report a fault: its operator resets it


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


ELEMENTAL_MOVE = MessageType(
    "elemental_move",
    1,
    (
        number("id", "serial of the move, rising by one from 1; 0: empty"),
        short_count("action", "index of the program's action that it serves"),
        Field("verb", "u1", Verb, "what to do"),
        row("object", "row of the object concerned in the world model; -1: none"),
        real("position", "m", "tool position at the end", 3),
        real("quaternion", "1", "tool orientation at the end", 4),
        by_joint("joints", "rad", "where MOVE_JOINTS ends; with `posture`, near the end"),
        flag(
            "posture", "1: of the configurations at the pose, the one nearest to `joints` is wanted"
        ),
        real("by", "s", "simulated time by which it must be done; 0: any time"),
    ),
)

TASK_PLAN = MessageType(
    "task_plan",
    1,
    (
        number("id", "serial of the plan"),
        Field("error", "u2", Error, "why the program is refused; 0: it is not refused"),
        Field("reason", "S120", "ASCII", "the refusal, readable"),
        real("earliest", "s", "with TOO_LATE: the earliest time that could be met"),
        short_count("count", "moves that follow"),
        Field("moves", ELEMENTAL_MOVE, "", "the program, decomposed", (MOVES,)),
    ),
)

TASK_COMMAND = command(
    "task_command",
    2,
    RESTS_ON,
    flag("hold", "1: ramp to rest and stay, whatever is under way"),
    short_count("count", "moves that follow; id is the newest one's"),
    Field("moves", ELEMENTAL_MOVE, "", "a window on the plan, oldest first", (WINDOW,)),
)

TASK_STATUS = status(
    "task_status",
    2,
    *ANSWER,
    short_count("action", "actions done"),
    short_count("actions", "actions of the program"),
    short_count("moves_done", "elemental moves done"),
    short_count("moves", "elemental moves of the plan; 0 before there is one"),
    number("first", "id under which the plan's first move is handed down"),
    number("detour", "id of the move that an operator wants instead; 0: none"),
)

OPERATED = flag("operated", "1: an operator keeps this level, or one below it, from its own work")

MOVE_STATUS = status(
    "move_status",
    3,
    *ANSWER,
    number("done", "newest elemental move done; 0: none yet"),
    number("current", "elemental move under way; 0: none"),
    real("progress", "1", "part of its path done, 0 to 1"),
    Field("verb", "u1", Verb, "of the move under way"),
    row("held", "row of the object in the gripper; -1: none"),
    number("planned", "newest elemental move whose path is ready; 0: none yet"),
    by_joint("end", "rad", "joint positions at the end of that path"),
    number("replan", "open request to plan the current move anew from `start`; 0: none is open"),
    by_joint("start", "rad", "joint positions where that motion holds"),
    number("replans", "plans made anew because something was in the way"),
    OPERATED,
    flag(
        "resting", "1: the arm rests, and the level that moves it has the operator's newest command"
    ),
)

MOVE_PLAN = MessageType(
    "move_plan",
    1,
    (
        number("move", "elemental move that the plan serves"),
        number("replan", "request that it answers; 0: the first plan of the move"),
        Field("error", "u2", Error, "why there is no plan; 0: there is"),
        Field("reason", "S120", "ASCII", "the error, readable"),
        Field("kind", "u1", SegmentKind, "path or gripper"),
        short_count("count", "waypoints that follow"),
        real("waypoints", "rad", "collision-free path in joint space", WAYPOINTS, "joints"),
        real(
            "blend", "rad", "length over which corner k is rounded, before and after it", WAYPOINTS
        ),
    ),
)

SEGMENT = MessageType(
    "segment",
    1,
    (
        number("id", "serial of the segment, rising by one from 1; 0: empty"),
        number("move", "elemental move that it serves"),
        Field("kind", "u1", SegmentKind, "path or gripper"),
        row("object", "object held, or to be grasped; -1: none"),
        flag("touch", "1: the object may touch supports and fingers (approach, depart)"),
        short_count("count", "waypoints that follow"),
        real(
            "waypoints",
            "rad",
            "path in joint space, from where the motion starts",
            WAYPOINTS,
            "joints",
        ),
        real("blend", "rad", "length over which corner k is rounded", WAYPOINTS),
        real("by", "s", "simulated time by which it must be done; 0: any time"),
        real("opening", "m or rad", "gripper joint position to go to, for GRIPPER"),
        real("force", "N or N m", "largest gripper force on the way and afterwards"),
    ),
)

MOVE_COMMAND = command(
    "move_command",
    2,
    RESTS_ON,
    flag("hold", "1: ramp to rest on the path and stay"),
    short_count("count", "segments that follow; id is the newest one's"),
    Field("segments", SEGMENT, "", "segments to do, oldest first", (SEGMENTS,)),
)

PRIMITIVE_STATUS = status(
    "primitive_status",
    3,
    *ANSWER,
    number("done", "newest segment done; 0: none yet"),
    number("current", "segment under way; 0: none"),
    real("progress", "1", "part of the segment's path done, 0 to 1"),
    flag("blocked", "1: motion holds because something is in the way"),
    flag("resting", "1: commanded velocity is zero"),
    OPERATED,
    row("held", "row of the object in the gripper; -1: none"),
    real("opening", "m or rad", "gripper joint position, measured"),
    by_joint("position", "rad", "joint positions commanded last"),
    real("earliest", "s", "with TOO_LATE: the earliest time that could be met"),
    real("ends", "s", "simulated time at which the segment under way should be done; 0: not known"),
    number("wants", "segment for which the level wants a trajectory of its planner; 0: none"),
    real("begin", "rad", "path parameter at which that trajectory is to begin, from rest"),
)

TRAJECTORY = MessageType(
    "trajectory",
    1,
    (
        number("segment", "segment that it serves"),
        Field("error", "u2", Error, "why there is none; 0: there is"),
        Field("reason", "S120", "ASCII", "the error, readable"),
        real("begin", "rad", "path parameter at which it begins"),
        real("duration", "s", "from rest to rest"),
        real("earliest", "s", "simulated time at which the segment could be done at the earliest"),
        short_count("count", "sections that follow"),
        real(
            "sections",
            "s, 1, 1/s, 1/s2, 1/s3",
            "start, s, ds, dds, jerk of the path parameter",
            SECTIONS,
            5,
        ),
    ),
)

JOINT_SET_POINT = command(
    "joint_set_point",
    2,
    RESTS_ON,
    tick("due", "tick at which the arm should be there; 0: no set point yet, hold"),
    by_joint("position", "rad", "joint positions"),
    by_joint("velocity", "rad/s", "joint velocities"),
    # For a servo level that feeds acceleration forward; the default one derives it from positions
    # and velocities.
    by_joint("acceleration", "rad/s2", "joint accelerations"),
    real("opening", "m or rad", "gripper joint position to go to"),
    real("force", "N or N m", "largest gripper force"),
    row("held", "row of the object in the gripper; -1: none"),
)

SERVO_PLAN = MessageType(
    "servo_plan",
    1,
    (
        real(
            "inertia", "kg m2", "joint-space inertia, the object held included", "joints", "joints"
        ),
        row("held", "object included; -1: none"),
        real("payload_mass", "kg", "mass in the gripper"),
        real("payload_offset", "m", "its centre, in the frame of the tool", 3),
    ),
)

DRIVEN_ARM = (
    by_joint("position", "rad", "joint positions, measured; estimated for suspect sensors"),
    by_joint("velocity", "rad/s", "joint velocities, likewise"),
    by_joint("torque", "N m", "torque given to the arm in this cycle, after the limit gate"),
    by_joint("target", "rad", "where the joints are wanted in this cycle"),
    by_joint("target_velocity", "rad/s", "likewise"),
    real("opening", "m or rad", "gripper joint position, measured"),
    real("opening_velocity", "m/s or rad/s", "gripper joint velocity, measured"),
    real("grip_force", "N or N m", "force given to the gripper"),
    flag("holding", "1: no fresh set point, the arm ramps to rest and stays"),
    flag("stopped", "1: set points are not followed: a demand, an operator, a fault, or brakes"),
    flag("braked", "1: the brakes are engaged"),
    Field("demand", "u1", Demand, "stop that the rack's safety demands in this cycle"),
    number("clipped", "cycles in which the limit gate cut a torque or a set point"),
    number("touches", "unintended contacts, counted at every substep"),
    number(
        "violations",
        "substeps in which the arm drove a position, velocity or torque beyond its limit",
    ),
    number("pushed", "substeps in which a blow pushed a joint beyond a limit"),
    flag("slowed", "1: speeds are scaled down by robot.bring_up, until the release of it"),
)
"""Fields of the status of a level that drives an arm."""

SERVO_STATUS = status("servo_status", 5, *ANSWER, *DRIVEN_ARM)

ARM_STATE = MessageType(
    "arm_state",
    3,
    (
        tick("tick", "tick that the state belongs to"),
        number("clipped", "cycles in which the limit gate cut a command"),
        number("touches", "unintended contacts"),
        number("violations", "substeps in which the arm broke a limit"),
        number("pushed", "substeps in which a blow pushed a joint beyond a limit"),
        Field("struck", "i4", "tick", "ticks for which the motion is still that of a blow"),
        Field("waited", "i4", "tick", "ticks since the last command"),
        flag("braked", "1: the brakes are engaged"),
        by_joint("rest", "rad", "where engaged brakes hold the joints"),
        by_joint("position", "rad", "joint positions as the servo level estimates them"),
        by_joint("velocity", "rad/s", "joint velocities, likewise"),
        by_joint("doubt", "rad", "largest error of those positions"),
        tick(
            "kept",
            "ticks for which faults have kept the arm from its set points: see ArmParams.patience",
        ),
        Field("error", "u2", Error, "latched fault; 0: none"),
        Field("reason", "S120", "ASCII", "that fault, readable"),
        real("state", "", "of the simulated cell, see rack.levels.robot.state", "state"),
    ),
)

SCENE = MessageType(
    "scene",
    1,
    (
        real("position", "m", "body origins as sensed", "bodies", 3),
        real("quaternion", "1", "body orientations as sensed", "bodies", 4),
        real("tool_position", "m", "tool as sensed", 3),
        real("tool_quaternion", "1", "tool as sensed", 4),
    ),
)

WORLD_MODEL = MessageType(
    "world_model",
    1,
    (
        number(
            "revision",
            "rises when a body starts to move and when it rests again; 0: nothing sensed",
        ),
        real("position", "m", "body origins", "bodies", 3),
        real("quaternion", "1", "body orientations", "bodies", 4),
        real("velocity", "m/s", "body velocities, estimated", "bodies", 3),
        tick("sensed", "cycle in which the newest scene was taken over"),
    ),
)
