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

from numpy import ndarray

from rack.backplane.message import field, integer
from rack.backplane.words import Demand
from rack.levels.messages import per_joint
from rack.levels.operator import AnsweringStatus, RelayedCommand, SampledCommand

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


DRIVEN = field("u1", unit="1", doc="1: the joint is one of this board's", shape="joints")
SENSED = field(unit="tick", doc="tick of the hand's status that it rests on; -1: none yet")


class TensionCommand(SampledCommand, version=1):
    """From the boards of tendon loops to the board of the hand."""

    sampled: int = field(
        unit="tick", doc="tick of the hand's status that it rests on; -1: none yet, so no tension"
    )
    tension: ndarray = field(
        unit="N", doc="of the tendons of the board's own joints", shape=(2, "joints")
    )
    driven: ndarray = DRIVEN


class HandStatus(AnsweringStatus, version=1):
    """From the board of the hand: 16 angles and 32 tensions of the Utah/MIT hand."""

    tick: int = field(unit="tick", doc="tick at which the hand was sensed")
    position: ndarray = per_joint("rad", "joint positions")
    velocity: ndarray = per_joint("rad/s", "joint velocities")
    torque: ndarray = per_joint("N m", "of the tendons on the joints")
    tension: ndarray = field(unit="N", doc="of the tendons, as sensed", shape=(2, "joints"))
    wanted: ndarray = field(unit="N", doc="tensions commanded of the valves", shape=(2, "joints"))
    force: ndarray = field(
        unit="N", doc="of the surroundings on the fingertips, as sensed", shape=("fingers", 3)
    )
    holding: bool = field(doc="1: no fresh tensions: the valves are closed")
    stopped: bool = field(
        doc="1: tensions are not followed: a demand, an operator, or a lost board"
    )
    demand: Demand = field(doc="stop that the rack's safety demands in this cycle")
    clipped: int = integer("cycles in which a tension was cut to its limits")
    touches: int = integer("unintended contacts, counted at every substep")
    violations: int = integer("substeps in which a tendon drove a joint beyond a limit")
    pushed: int = integer("substeps in which a blow pushed a joint beyond a limit")


class TendonTorque(RelayedCommand, version=1):
    """From the joint loop to the tendon loop."""

    sampled: int = field(
        unit="tick", doc="tick of the hand's status that it rests on; -1: none yet"
    )
    torque: ndarray = per_joint("N m", "of the joints")


class FingerTarget(RelayedCommand, version=1):
    """From the fingertip loop to the joint loop."""

    active: bool = field(doc="0: no target yet, hold")
    position: ndarray = per_joint("rad", "joint positions")
    velocity: ndarray = per_joint("rad/s", "joint velocities")
    stiff: ndarray = per_joint(
        "1", "part of the joint loop's stiffness that acts, 0 to 1; its damping acts"
    )
    torque: ndarray = per_joint("N m", "in addition: of the forces of tips")
    spring: ndarray = field(
        unit="N m/rad",
        doc="in addition: stiffness of tips, by joint and joint",
        shape=("joints", "joints"),
    )


class GraspTarget(RelayedCommand, version=1):
    """From the grasp loop to the fingertip loop, or to the boards of fingers."""

    active: bool = field(doc="0: no target yet, hold")
    mode: ndarray = field(
        "u1", unit=FingerMode, doc="how each finger is controlled", shape="fingers"
    )
    position: ndarray = per_joint("rad", "joint positions, for JOINTS")
    velocity: ndarray = per_joint("rad/s", "joint velocities, for JOINTS")
    tip: ndarray = field(
        unit="m", doc="points of the tips, for POINT and FORCE", shape=("fingers", 3)
    )
    tip_velocity: ndarray = field(unit="m/s", doc="their velocities", shape=("fingers", 3))
    stiffness: ndarray = field(
        unit="N/m", doc="of each tip about its point, for FORCE", shape="fingers"
    )
    force: ndarray = field(
        unit="N",
        doc="of each tip on the surroundings, at its point, for FORCE",
        shape=("fingers", 3),
    )


class LoopStatus(AnsweringStatus, version=1):
    """From the tendon loop to the joint loop, and from that to the fingertip loop."""

    driven: ndarray = DRIVEN
    sensed: int = SENSED
    clipped: int = integer("cycles in which a torque was cut to what tendons can give")
    holding: bool = field(doc="1: no fresh command from above: what was commanded last is kept")
    stopped: bool = field(
        doc="1: commands are not followed: the hand is stopped, or an operator holds the loop"
    )


class FingerStatus(AnsweringStatus, version=1):
    """From the fingertip loop, or from a board that runs all loops of a finger, to the grasp
    loop."""

    driven: ndarray = field(
        "u1", unit="1", doc="1: the finger is one of this board's", shape="fingers"
    )
    sensed: int = SENSED
    position: ndarray = per_joint("rad", "joint positions, from the hand's status")
    target: ndarray = per_joint("rad", "joint positions wanted")
    tip: ndarray = field(unit="m", doc="points of the tips", shape=("fingers", 3))
    force: ndarray = field(unit="N", doc="of the surroundings on the tips", shape=("fingers", 3))
    holding: bool = field(doc="1: no fresh target: the fingers stay")
    stopped: bool = field(
        doc="1: targets are not followed: the hand is stopped, or an operator holds a loop"
    )


class GraspStatus(AnsweringStatus, version=1):
    """From the grasp loop. Points and forces are in the frame of the palm."""

    step: int = integer("steps of the program that are done", "u2")
    steps: int = integer("steps of the program", "u2")
    kind: GraspKind = field(doc="of the step under way")
    passed: float = field(unit="s", doc="time for which that step is under way")
    object: int = integer("row of the object grasped, in the world model; -1: none", "i2")
    touching: ndarray = field(
        "u1", unit="1", doc="1: the finger touches the object", shape="fingers"
    )
    grip: float = field(
        unit="N", doc="internal force of the finger that opposes the others; they share it"
    )
    load: ndarray = field(unit="N", doc="that the grasp makes up for: weight and pull", shape=3)
    anchor: ndarray = field(unit="m", doc="where the object is to be", shape=3)
    moved: float = field(unit="m", doc="distance of the object from there")
    farthest: float = field(unit="m", doc="largest such distance since the object was gripped")
    plan: int = integer("id of the grasp plan in use; 0: none")


class GraspPlan(RelayedCommand, version=1):
    """From a planner, on a board or on the host side, to the grasp loop: where the fingers take
    hold of
    an object, and from which posture they close. The newest with an `id` above 0 counts."""

    object: int = integer("row of the object in the world model", "i2")
    sensed: int = field(unit="tick", doc="tick of the world model that it rests on")
    posture: ndarray = per_joint("rad", "joint positions from which the fingers close")
    contact: ndarray = field(
        unit="m",
        doc="of each tip, on the object's surface, in the object's frame",
        shape=("fingers", 3),
    )
    normal: ndarray = field(
        unit="1",
        doc="direction of each tip's force there, in the object's frame",
        shape=("fingers", 3),
    )
    grip: float = field(unit="N", doc="force of each finger; the opposing one bears their sum")


STREAMED_DOWN = (
    TensionCommand.message_type.name,
    TendonTorque.message_type.name,
    FingerTarget.message_type.name,
    GraspTarget.message_type.name,
)
"""Names of commands that change in every cycle."""
