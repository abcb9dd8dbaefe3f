"""The messages of the default rack: commands go down, statuses come up, plans stay within a level.

Symbolic sizes: `joints`, `bodies` (objects, then obstacles; at least 1) and `state` (of a simulated
cell, see `rack.levels.robot.state`). Quaternions are w, x, y, z. Poses are in the world frame.
Simulated time is tick times the clock's period.
"""

from enum import IntEnum

from rack.backplane.message import Field, MessageType, command, status
from rack.backplane.words import Demand
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

JOINTS = ("joints",)
"""Shape of a field with one value per joint."""


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
        Field("id", "u4", "1", "serial of the move, rising by one from 1; 0: empty"),
        Field("action", "u2", "1", "index of the program's action that it serves"),
        Field("verb", "u1", Verb, "what to do"),
        Field("object", "i2", "1", "row of the object concerned in the world model; -1: none"),
        Field("position", "f8", "m", "tool position at the end", (3,)),
        Field("quaternion", "f8", "1", "tool orientation at the end", (4,)),
        Field(
            "joints",
            "f8",
            "rad",
            "where MOVE_JOINTS ends; with `posture`, near the end",
            JOINTS,
        ),
        Field(
            "posture",
            "u1",
            "1",
            "1: of the configurations at the pose, the one nearest to `joints` is wanted",
        ),
        Field("by", "f8", "s", "simulated time by which it must be done; 0: any time"),
    ),
)

TASK_PLAN = MessageType(
    "task_plan",
    1,
    (
        Field("id", "u4", "1", "serial of the plan"),
        Field("error", "u2", Error, "why the program is refused; 0: it is not refused"),
        Field("reason", "S120", "ASCII", "the refusal, readable"),
        Field("earliest", "f8", "s", "with TOO_LATE: the earliest time that could be met"),
        Field("count", "u2", "1", "moves that follow"),
        Field("moves", ELEMENTAL_MOVE, "", "the program, decomposed", (MOVES,)),
    ),
)

TASK_COMMAND = command(
    "task_command",
    2,
    RESTS_ON,
    Field("hold", "u1", "1", "1: ramp to rest and stay, whatever is under way"),
    Field("count", "u2", "1", "moves that follow; id is the newest one's"),
    Field("moves", ELEMENTAL_MOVE, "", "a window on the plan, oldest first", (WINDOW,)),
)

TASK_STATUS = status(
    "task_status",
    2,
    *ANSWER,
    Field("action", "u2", "1", "actions done"),
    Field("actions", "u2", "1", "actions of the program"),
    Field("moves_done", "u2", "1", "elemental moves done"),
    Field("moves", "u2", "1", "elemental moves of the plan; 0 before there is one"),
    Field("first", "u4", "1", "id under which the plan's first move is handed down"),
    Field("detour", "u4", "1", "id of the move that an operator wants instead; 0: none"),
)

OPERATED = Field(
    "operated", "u1", "1", "1: an operator keeps this level, or one below it, from its own work"
)

MOVE_STATUS = status(
    "move_status",
    3,
    *ANSWER,
    Field("done", "u4", "1", "newest elemental move done; 0: none yet"),
    Field("current", "u4", "1", "elemental move under way; 0: none"),
    Field("progress", "f8", "1", "part of its path done, 0 to 1"),
    Field("verb", "u1", Verb, "of the move under way"),
    Field("held", "i2", "1", "row of the object in the gripper; -1: none"),
    Field("planned", "u4", "1", "newest elemental move whose path is ready; 0: none yet"),
    Field("end", "f8", "rad", "joint positions at the end of that path", JOINTS),
    Field(
        "replan",
        "u4",
        "1",
        "open request to plan the current move anew from `start`; 0: none is open",
    ),
    Field("start", "f8", "rad", "joint positions where that motion holds", JOINTS),
    Field("replans", "u4", "1", "plans made anew because something was in the way"),
    OPERATED,
    Field(
        "resting",
        "u1",
        "1",
        "1: the arm rests, and the level that moves it has the operator's newest command",
    ),
)

MOVE_PLAN = MessageType(
    "move_plan",
    1,
    (
        Field("move", "u4", "1", "elemental move that the plan serves"),
        Field("replan", "u4", "1", "request that it answers; 0: the first plan of the move"),
        Field("error", "u2", Error, "why there is no plan; 0: there is"),
        Field("reason", "S120", "ASCII", "the error, readable"),
        Field("kind", "u1", SegmentKind, "path or gripper"),
        Field("count", "u2", "1", "waypoints that follow"),
        Field(
            "waypoints", "f8", "rad", "collision-free path in joint space", (WAYPOINTS, "joints")
        ),
        Field(
            "blend",
            "f8",
            "rad",
            "length over which corner k is rounded, before and after it",
            (WAYPOINTS,),
        ),
    ),
)

SEGMENT = MessageType(
    "segment",
    1,
    (
        Field("id", "u4", "1", "serial of the segment, rising by one from 1; 0: empty"),
        Field("move", "u4", "1", "elemental move that it serves"),
        Field("kind", "u1", SegmentKind, "path or gripper"),
        Field("object", "i2", "1", "object held, or to be grasped; -1: none"),
        Field(
            "touch", "u1", "1", "1: the object may touch supports and fingers (approach, depart)"
        ),
        Field("count", "u2", "1", "waypoints that follow"),
        Field(
            "waypoints",
            "f8",
            "rad",
            "path in joint space, from where the motion starts",
            (WAYPOINTS, "joints"),
        ),
        Field("blend", "f8", "rad", "length over which corner k is rounded", (WAYPOINTS,)),
        Field("by", "f8", "s", "simulated time by which it must be done; 0: any time"),
        Field("opening", "f8", "m or rad", "gripper joint position to go to, for GRIPPER"),
        Field("force", "f8", "N or N m", "largest gripper force on the way and afterwards"),
    ),
)

MOVE_COMMAND = command(
    "move_command",
    2,
    RESTS_ON,
    Field("hold", "u1", "1", "1: ramp to rest on the path and stay"),
    Field("count", "u2", "1", "segments that follow; id is the newest one's"),
    Field("segments", SEGMENT, "", "segments to do, oldest first", (SEGMENTS,)),
)

PRIMITIVE_STATUS = status(
    "primitive_status",
    3,
    *ANSWER,
    Field("done", "u4", "1", "newest segment done; 0: none yet"),
    Field("current", "u4", "1", "segment under way; 0: none"),
    Field("progress", "f8", "1", "part of the segment's path done, 0 to 1"),
    Field("blocked", "u1", "1", "1: motion holds because something is in the way"),
    Field("resting", "u1", "1", "1: commanded velocity is zero"),
    OPERATED,
    Field("held", "i2", "1", "row of the object in the gripper; -1: none"),
    Field("opening", "f8", "m or rad", "gripper joint position, measured"),
    Field("position", "f8", "rad", "joint positions commanded last", JOINTS),
    Field("earliest", "f8", "s", "with TOO_LATE: the earliest time that could be met"),
    Field(
        "ends",
        "f8",
        "s",
        "simulated time at which the segment under way should be done; 0: not known",
    ),
    Field(
        "wants", "u4", "1", "segment for which the level wants a trajectory of its planner; 0: none"
    ),
    Field("begin", "f8", "rad", "path parameter at which that trajectory is to begin, from rest"),
)

TRAJECTORY = MessageType(
    "trajectory",
    1,
    (
        Field("segment", "u4", "1", "segment that it serves"),
        Field("error", "u2", Error, "why there is none; 0: there is"),
        Field("reason", "S120", "ASCII", "the error, readable"),
        Field("begin", "f8", "rad", "path parameter at which it begins"),
        Field("duration", "f8", "s", "from rest to rest"),
        Field(
            "earliest",
            "f8",
            "s",
            "simulated time at which the segment could be done at the earliest",
        ),
        Field("count", "u2", "1", "sections that follow"),
        Field(
            "sections",
            "f8",
            "s, 1, 1/s, 1/s2, 1/s3",
            "start, s, ds, dds, jerk of the path parameter",
            (SECTIONS, 5),
        ),
    ),
)

JOINT_SET_POINT = command(
    "joint_set_point",
    2,
    RESTS_ON,
    Field("due", "i8", "tick", "tick at which the arm should be there; 0: no set point yet, hold"),
    Field("position", "f8", "rad", "joint positions", JOINTS),
    Field("velocity", "f8", "rad/s", "joint velocities", JOINTS),
    # For a servo level that feeds acceleration forward; the default one derives it from positions
    # and velocities.
    Field("acceleration", "f8", "rad/s2", "joint accelerations", JOINTS),
    Field("opening", "f8", "m or rad", "gripper joint position to go to"),
    Field("force", "f8", "N or N m", "largest gripper force"),
    Field("held", "i2", "1", "row of the object in the gripper; -1: none"),
)

SERVO_PLAN = MessageType(
    "servo_plan",
    1,
    (
        Field(
            "inertia",
            "f8",
            "kg m2",
            "joint-space inertia, the object held included",
            ("joints", "joints"),
        ),
        Field("held", "i2", "1", "object included; -1: none"),
        Field("payload_mass", "f8", "kg", "mass in the gripper"),
        Field("payload_offset", "f8", "m", "its centre, in the frame of the tool", (3,)),
    ),
)

DRIVEN_ARM = (
    Field(
        "position",
        "f8",
        "rad",
        "joint positions, measured; estimated for suspect sensors",
        JOINTS,
    ),
    Field("velocity", "f8", "rad/s", "joint velocities, likewise", JOINTS),
    Field(
        "torque",
        "f8",
        "N m",
        "torque given to the arm in this cycle, after the limit gate",
        JOINTS,
    ),
    Field("target", "f8", "rad", "where the joints are wanted in this cycle", JOINTS),
    Field("target_velocity", "f8", "rad/s", "likewise", JOINTS),
    Field("opening", "f8", "m or rad", "gripper joint position, measured"),
    Field("opening_velocity", "f8", "m/s or rad/s", "gripper joint velocity, measured"),
    Field("grip_force", "f8", "N or N m", "force given to the gripper"),
    Field("holding", "u1", "1", "1: no fresh set point, the arm ramps to rest and stays"),
    Field(
        "stopped",
        "u1",
        "1",
        "1: set points are not followed: a demand, an operator, a fault, or brakes",
    ),
    Field("braked", "u1", "1", "1: the brakes are engaged"),
    Field("demand", "u1", Demand, "stop that the rack's safety demands in this cycle"),
    Field("clipped", "u4", "1", "cycles in which the limit gate cut a torque or a set point"),
    Field("touches", "u4", "1", "unintended contacts, counted at every substep"),
    Field(
        "violations",
        "u4",
        "1",
        "substeps in which the arm drove a position, velocity or torque beyond its limit",
    ),
    Field("pushed", "u4", "1", "substeps in which a blow pushed a joint beyond a limit"),
    Field(
        "slowed", "u1", "1", "1: speeds are scaled down by robot.bring_up, until the release of it"
    ),
)
"""Fields of the status of a level that drives an arm."""

SERVO_STATUS = status("servo_status", 5, *ANSWER, *DRIVEN_ARM)

ARM_STATE = MessageType(
    "arm_state",
    3,
    (
        Field("tick", "i8", "tick", "tick that the state belongs to"),
        Field("clipped", "u4", "1", "cycles in which the limit gate cut a command"),
        Field("touches", "u4", "1", "unintended contacts"),
        Field("violations", "u4", "1", "substeps in which the arm broke a limit"),
        Field("pushed", "u4", "1", "substeps in which a blow pushed a joint beyond a limit"),
        Field("struck", "i4", "tick", "ticks for which the motion is still that of a blow"),
        Field("waited", "i4", "tick", "ticks since the last command"),
        Field("braked", "u1", "1", "1: the brakes are engaged"),
        Field("rest", "f8", "rad", "where engaged brakes hold the joints", JOINTS),
        Field(
            "position",
            "f8",
            "rad",
            "joint positions as the servo level estimates them",
            JOINTS,
        ),
        Field("velocity", "f8", "rad/s", "joint velocities, likewise", JOINTS),
        Field("doubt", "f8", "rad", "largest error of those positions", JOINTS),
        Field(
            "kept",
            "i8",
            "tick",
            "ticks for which faults have kept the arm from its set points: see ArmParams.patience",
        ),
        Field("error", "u2", Error, "latched fault; 0: none"),
        Field("reason", "S120", "ASCII", "that fault, readable"),
        Field("state", "f8", "", "of the simulated cell, see rack.levels.robot.state", ("state",)),
    ),
)

SCENE = MessageType(
    "scene",
    1,
    (
        Field("position", "f8", "m", "body origins as sensed", ("bodies", 3)),
        Field("quaternion", "f8", "1", "body orientations as sensed", ("bodies", 4)),
        Field("tool_position", "f8", "m", "tool as sensed", (3,)),
        Field("tool_quaternion", "f8", "1", "tool as sensed", (4,)),
    ),
)

WORLD_MODEL = MessageType(
    "world_model",
    1,
    (
        Field(
            "revision",
            "u4",
            "1",
            "rises when a body starts to move and when it rests again; 0: nothing sensed",
        ),
        Field("position", "f8", "m", "body origins", ("bodies", 3)),
        Field("quaternion", "f8", "1", "body orientations", ("bodies", 4)),
        Field("velocity", "f8", "m/s", "body velocities, estimated", ("bodies", 3)),
        Field("sensed", "i8", "tick", "cycle in which the newest scene was taken over"),
    ),
)
