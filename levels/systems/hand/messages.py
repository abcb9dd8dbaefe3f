"""The messages of a hand: tensions, angles, and the targets of the loops between them.

Symbolic sizes are `joints` of the hand, in the order of `robot.joints`, and `fingers`, in the order
of `robot.hand`. Vectors have all joints or all fingers; a board that drives only some of them fills
and uses their elements, and the others are 0. Tensions have two rows, flexors and extensors. The
tension of a flexor turns its joint in the positive direction. Points and forces are in the frame of
the palm, which is the site `robot.tool`.
"""

from __future__ import annotations

from enum import IntEnum

from numpy import ndarray

from rack.backplane.message import Message, field, integer_field
from rack.backplane.words import Demand
from rack.levels.messages import joint_field
from rack.levels.operator import AnsweringStatus, RelayedCommand, SampledCommand

FLEXOR = 0
EXTENSOR = 1
"""Row indices of tensions."""


class FingerMode(IntEnum):
    """Modes in which a finger is controlled."""

    JOINTS = 0  # the joints move to positions
    POINT = 1  # the tip moves to a point
    FORCE = 2  # the tip exerts a force, and acts as a spring about a point


class GraspKind(IntEnum):
    """Kinds of steps of a grasp."""

    NONE = 0
    PRESHAPE = 1  # joints move to a posture
    CLOSE = 2  # tips move to an object until they touch it
    SQUEEZE = 3  # forces rise
    SHIFT = 4  # the fingers move the object
    HOLD = 5  # the object is held in place
    RELEASE = 6  # forces fall, tips withdraw


DRIVEN = field("u1", unit="1", doc="1 for joints of this board", shape="joints")
SENSED = field(unit="tick", doc="tick of the hand's status on which it depends, -1 without one")


class TensionCommand(SampledCommand, version=1):
    """From the boards of tendon loops to the board of the hand."""

    sampled: int = field(
        unit="tick",
        doc="tick of the hand's status on which the tensions depend, -1 if there are none",
    )
    tension: ndarray = field(
        unit="N", doc="tensions of the tendons of this board's joints", shape=(2, "joints")
    )
    driven: ndarray = DRIVEN


class HandStatus(AnsweringStatus, version=1):
    """From the board of the hand: 16 angles and 32 tensions of the Utah/MIT hand."""

    tick: int = field(unit="tick", doc="tick at which the hand was sensed")
    position: ndarray = joint_field("rad", "joint positions")
    velocity: ndarray = joint_field("rad/s", "joint velocities")
    torque: ndarray = joint_field("N m", "torques of the tendons on the joints")
    tension: ndarray = field(unit="N", doc="sensed tensions of the tendons", shape=(2, "joints"))
    wanted: ndarray = field(unit="N", doc="tensions commanded of the valves", shape=(2, "joints"))
    force: ndarray = field(
        unit="N", doc="sensed forces of the environment on the fingertips", shape=("fingers", 3)
    )
    holding: bool = field(
        doc="1 if the valves are closed, for lack of fresh tensions or another reason"
    )
    stopped: bool = field(
        doc="1 if tensions are ignored because of a demand, an operator, or a lost board"
    )
    demand: Demand = field(doc="safety demand in this cycle")
    clipped: int = integer_field("cycles in which a tension was limited")
    touches: int = integer_field("unintended contacts, counted at every substep")
    violations: int = integer_field("substeps in which a tendon drove a joint beyond a limit")
    pushed: int = integer_field("substeps in which a blow pushed a joint beyond a limit")


class TendonTorque(RelayedCommand, version=1):
    """From the joint loop to the tendon loop."""

    sampled: int = field(
        unit="tick", doc="tick of the hand's status on which it depends, -1 without one"
    )
    torque: ndarray = joint_field("N m", "torques of the joints")


class FingerTarget(RelayedCommand, version=1):
    """From the fingertip loop to the joint loop."""

    active: bool = field(doc="0 until there is a target")
    position: ndarray = joint_field("rad", "joint positions")
    velocity: ndarray = joint_field("rad/s", "joint velocities")
    stiff: ndarray = joint_field(
        "1", "scale of the joint loop's stiffness, 0 to 1; its damping is not scaled"
    )
    torque: ndarray = joint_field("N m", "additional torques, from forces of the tips")
    spring: ndarray = field(
        unit="N m/rad",
        doc="additional joint stiffness, from springs at the tips",
        shape=("joints", "joints"),
    )


class GraspTarget(RelayedCommand, version=1):
    """From the grasp loop to the fingertip loop, or to the boards of fingers."""

    active: bool = field(doc="0 until there is a target")
    mode: ndarray = field("u1", unit=FingerMode, doc="mode of each finger", shape="fingers")
    position: ndarray = joint_field("rad", "joint positions in mode JOINTS")
    velocity: ndarray = joint_field("rad/s", "joint velocities in mode JOINTS")
    tip: ndarray = field(
        unit="m", doc="points of the tips in modes POINT and FORCE", shape=("fingers", 3)
    )
    tip_velocity: ndarray = field(
        unit="m/s", doc="velocities of these points", shape=("fingers", 3)
    )
    stiffness: ndarray = field(
        unit="N/m", doc="stiffness of each tip about its point in mode FORCE", shape="fingers"
    )
    force: ndarray = field(
        unit="N",
        doc="force of each tip on the environment in mode FORCE",
        shape=("fingers", 3),
    )


class LoopStatus(AnsweringStatus, version=1):
    """From the tendon loop to the joint loop, and from that to the fingertip loop."""

    driven: ndarray = DRIVEN
    sensed: int = SENSED
    clipped: int = integer_field(
        "cycles in which a torque was limited to what the tendons can exert"
    )
    holding: bool = field(doc="1 if the last command stays in force for lack of a fresh one")
    stopped: bool = field(
        doc="1 if commands are ignored because the hand is stopped or an operator holds the loop"
    )


class FingerStatus(AnsweringStatus, version=1):
    """Status of a fingertip loop, or of a board with all loops of a finger, for the grasp loop."""

    driven: ndarray = field("u1", unit="1", doc="1 for fingers of this board", shape="fingers")
    sensed: int = SENSED
    position: ndarray = joint_field("rad", "joint positions, from the hand's status")
    target: ndarray = joint_field("rad", "joint targets")
    tip: ndarray = field(unit="m", doc="positions of the tips", shape=("fingers", 3))
    force: ndarray = field(
        unit="N", doc="forces of the environment on the tips", shape=("fingers", 3)
    )
    holding: bool = field(doc="1 if the fingers stay for lack of a fresh target")
    stopped: bool = field(
        doc="1 if targets are ignored because the hand is stopped or an operator holds a loop"
    )


class GraspStatus(AnsweringStatus, version=1):
    """From the grasp loop. Points and forces are in the frame of the palm."""

    step: int = integer_field("number of completed steps", "u2")
    steps: int = integer_field("number of steps of the program", "u2")
    kind: GraspKind = field(doc="kind of the current step")
    passed: float = field(unit="s", doc="execution time of the current step")
    object: int = integer_field(
        "row of the gripped object in the world model, -1 without one", "i2"
    )
    touching: ndarray = field(
        "u1", unit="1", doc="1 for fingers that touch the object", shape="fingers"
    )
    grip: float = field(unit="N", doc="internal force of the opposing finger, shared by the others")
    load: ndarray = field(unit="N", doc="force of the grasp against weight and pull", shape=3)
    anchor: ndarray = field(unit="m", doc="target position of the object", shape=3)
    moved: float = field(unit="m", doc="distance of the object from its target position")
    farthest: float = field(unit="m", doc="largest such distance since the object was gripped")
    plan: int = integer_field("id of the grasp plan in use, 0 without one")


class GraspPlan(RelayedCommand, version=1):
    """Contacts of the fingers on an object, and the posture from which they close.

    It comes from a planner, on a board or on the host side, and goes to the grasp loop. The newest
    message with an `id` above 0 is used.
    """

    object: int = integer_field("row of the object in the world model", "i2")
    sensed: int = field(unit="tick", doc="tick of the world model on which it depends")
    posture: ndarray = joint_field("rad", "joint positions from which the fingers close")
    contact: ndarray = field(
        unit="m",
        doc="contact of each tip on the object's surface, in the object's frame",
        shape=("fingers", 3),
    )
    normal: ndarray = field(
        unit="1",
        doc="unit vector of each tip's force, in the object's frame",
        shape=("fingers", 3),
    )
    grip: float = field(
        unit="N", doc="force of each finger except the opposing one, which bears their sum"
    )


class HostWords(Message, version=1):
    """Words that a workstation has written into the crate's memory."""

    word: ndarray = field(
        "i8",
        unit="1",
        doc="scratch words; the first is a force in mN that is added to the grip force",
        shape=8,
    )


STREAMED_DOWN = (
    TensionCommand.message_type.name,
    TendonTorque.message_type.name,
    FingerTarget.message_type.name,
    GraspTarget.message_type.name,
)
"""Names of commands that change in every cycle."""
