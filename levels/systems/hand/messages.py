"""The messages of a hand: tensions down to the valves, angles and tensions up, and the targets of
the loops between.

Symbolic sizes: `joints` of the hand, in the order of `robot.joints`, and `fingers`, in the order of
`robot.hand`. Vectors have all joints and all fingers; a board of some of them fills and obeys its
own, others are 0. Tensions have two rows, flexors and extensors: a flexor's tension turns its joint
in the positive direction. Points and forces are in the frame of the palm, which is the site
`robot.tool`.
"""

from __future__ import annotations

from enum import IntEnum

from rack.backplane.message import Field, command, status
from rack.backplane.words import Demand
from rack.levels.fields import by_joint, flag, number, real, row, short_count, tick
from rack.levels.operator import ANSWER, RESTS_ON

FLEXOR = 0
EXTENSOR = 1
"""Rows of tensions."""


class FingerMode(IntEnum):
    """Modes in which a finger is controlled."""

    JOINTS = 0  # its joints go to positions
    POINT = 1  # its joints go to where its tip is at a point
    FORCE = 2  # its tip exerts a force, and is a spring of given stiffness about a point


class GraspKind(IntEnum):
    """Kinds of steps of a grasp."""

    NONE = 0
    PRESHAPE = 1  # joints go to a posture
    CLOSE = 2  # tips go to an object until they touch it
    SQUEEZE = 3  # forces rise
    SHIFT = 4  # the object is moved within the hand
    HOLD = 5  # the object is kept
    RELEASE = 6  # tips let go and withdraw


MOTION = (
    by_joint("position", "rad", "joint positions"),
    by_joint("velocity", "rad/s", "joint velocities"),
)
DRIVEN = flag("driven", "1: the joint is one of this board's", "joints")
SENSED = tick("sensed", "tick of the hand's status that it rests on; -1: none yet")

TENSION_COMMAND = command(
    "tension_command",
    1,
    RESTS_ON,
    tick("sampled", "tick of the hand's status that it rests on; -1: none yet, so no tension"),
    real("tension", "N", "of the tendons of the board's own joints", 2, "joints"),
    DRIVEN,
)
"""From the boards of tendon loops to the board of the hand."""

HAND_STATUS = status(
    "hand_status",
    1,
    *ANSWER,
    tick("tick", "tick at which the hand was sensed"),
    *MOTION,
    by_joint("torque", "N m", "of the tendons on the joints"),
    real("tension", "N", "of the tendons, as sensed", 2, "joints"),
    real("wanted", "N", "tensions commanded of the valves", 2, "joints"),
    real("force", "N", "of the surroundings on the fingertips, as sensed", "fingers", 3),
    flag("holding", "1: no fresh tensions: the valves are closed"),
    flag("stopped", "1: tensions are not followed: a demand, an operator, or a lost board"),
    Field("demand", "u1", Demand, "stop that the rack's safety demands in this cycle"),
    number("clipped", "cycles in which a tension was cut to its limits"),
    number("touches", "unintended contacts, counted at every substep"),
    number("violations", "substeps in which a tendon drove a joint beyond a limit"),
    number("pushed", "substeps in which a blow pushed a joint beyond a limit"),
)
"""From the board of the hand: 16 angles and 32 tensions of the Utah/MIT hand."""

TENDON_TORQUE = command(
    "tendon_torque",
    1,
    RESTS_ON,
    tick("sampled", "tick of the hand's status that it rests on; -1: none yet"),
    by_joint("torque", "N m", "of the joints"),
)
"""From the joint loop to the tendon loop."""

FINGER_TARGET = command(
    "finger_target",
    1,
    RESTS_ON,
    flag("active", "0: no target yet, hold"),
    *MOTION,
    by_joint(
        "stiff", "1", "part of the joint loop's stiffness that acts, 0 to 1; its damping acts"
    ),
    by_joint("torque", "N m", "in addition: of the forces of tips"),
    real(
        "spring",
        "N m/rad",
        "in addition: stiffness of tips, by joint and joint",
        "joints",
        "joints",
    ),
)
"""From the fingertip loop to the joint loop."""

GRASP_TARGET = command(
    "grasp_target",
    1,
    RESTS_ON,
    flag("active", "0: no target yet, hold"),
    Field("mode", "u1", FingerMode, "how each finger is controlled", ("fingers",)),
    by_joint("position", "rad", "joint positions, for JOINTS"),
    by_joint("velocity", "rad/s", "joint velocities, for JOINTS"),
    real("tip", "m", "points of the tips, for POINT and FORCE", "fingers", 3),
    real("tip_velocity", "m/s", "their velocities", "fingers", 3),
    real("stiffness", "N/m", "of each tip about its point, for FORCE", "fingers"),
    real("force", "N", "of each tip on the surroundings, at its point, for FORCE", "fingers", 3),
)
"""From the grasp loop to the fingertip loop, or to the boards of fingers."""

LOOP_STATUS = status(
    "loop_status",
    1,
    *ANSWER,
    DRIVEN,
    SENSED,
    number("clipped", "cycles in which a torque was cut to what tendons can give"),
    flag("holding", "1: no fresh command from above: what was commanded last is kept"),
    flag(
        "stopped",
        "1: commands are not followed: the hand is stopped, or an operator holds the loop",
    ),
)
"""From the tendon loop to the joint loop, and from that to the fingertip loop."""

FINGER_STATUS = status(
    "finger_status",
    1,
    *ANSWER,
    flag("driven", "1: the finger is one of this board's", "fingers"),
    SENSED,
    by_joint("position", "rad", "joint positions, from the hand's status"),
    by_joint("target", "rad", "joint positions wanted"),
    real("tip", "m", "points of the tips", "fingers", 3),
    real("force", "N", "of the surroundings on the tips", "fingers", 3),
    flag("holding", "1: no fresh target: the fingers stay"),
    flag(
        "stopped", "1: targets are not followed: the hand is stopped, or an operator holds a loop"
    ),
)
"""From the fingertip loop, or from a board that runs all loops of a finger, to the grasp loop."""

GRASP_STATUS = status(
    "grasp_status",
    1,
    *ANSWER,
    short_count("step", "steps of the program that are done"),
    short_count("steps", "steps of the program"),
    Field("kind", "u1", GraspKind, "of the step under way"),
    real("passed", "s", "time for which that step is under way"),
    row("object", "row of the object grasped, in the world model; -1: none"),
    flag("touching", "1: the finger touches the object", "fingers"),
    real("grip", "N", "internal force of the finger that opposes the others; they share it"),
    real("load", "N", "that the grasp makes up for: weight and pull", 3),
    real("anchor", "m", "where the object is to be", 3),
    real("moved", "m", "distance of the object from there"),
    real("farthest", "m", "largest such distance since the object was gripped"),
    number("plan", "id of the grasp plan in use; 0: none"),
)
"""From the grasp loop. Points and forces are in the frame of the palm."""

GRASP_PLAN = command(
    "grasp_plan",
    1,
    RESTS_ON,
    row("object", "row of the object in the world model"),
    tick("sensed", "tick of the world model that it rests on"),
    by_joint("posture", "rad", "joint positions from which the fingers close"),
    real(
        "contact", "m", "of each tip, on the object's surface, in the object's frame", "fingers", 3
    ),
    real("normal", "1", "direction of each tip's force there, in the object's frame", "fingers", 3),
    real("grip", "N", "force of each finger; the opposing one bears their sum"),
)
"""From a planner, on a board or on the host side, to the grasp loop: where the fingers take hold of
an object, and from which posture they close. The newest with an `id` above 0 counts."""

STREAMED_DOWN = (TENSION_COMMAND.name, TENDON_TORQUE.name, FINGER_TARGET.name, GRASP_TARGET.name)
"""Names of commands that change in every cycle."""
