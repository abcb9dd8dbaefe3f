"""The messages between a trajectory level, the boards that servo joints, and the board of the arm.

Every vector has all joints of the arm; a board of some joints fills and obeys the entries of its
joints. Symbolic sizes are defined in `rack.levels.messages`.

Your own level that servoes joints:

- names them in its parameter `joints` (default: all), and sets `gripper = true` if it drives the
  gripper.
- writes a `JointTorque` in every cycle, for the time when it acts: one cycle after the release.
  `sampled` shows the arm on which of its statuses the torque is based; a torque based on a status
  that is too old brakes the arm.
- wants its joints where they are while the arm reports `braked`; only then are the brakes released.
  While the arm only reports `stopped`, the level brings the joints to rest and holds them. An arm
  that still moves after the time that this takes is braked.

Your own level above these writes no set point (`due = 0`) while one of them is `stopped`, and
starts again where they hold the arm.
"""

from __future__ import annotations

from numpy import ndarray

from rack.backplane.message import field
from rack.levels.messages import DrivenArm, JointCommand, ServoStatus, joint_field
from rack.levels.operator import AnsweringStatus, RelayedCommand, SampledCommand


class JointReference(RelayedCommand, version=1):
    """Sent by the trajectory level to all boards that servo joints, which interpolate it."""

    due: int = field(
        unit="tick", doc="tick at which the arm should be at the set point, or 0 to hold"
    )
    position: ndarray = joint_field("rad", "joint positions")
    velocity: ndarray = joint_field("rad/s", "joint velocities")
    acceleration: ndarray = joint_field("rad/s2", "joint accelerations")
    inertia: ndarray = joint_field("kg m2", "diagonal of the joint-space inertia there")
    load: ndarray = joint_field("N m", "torques of gravity and motion there, without acceleration")
    opening: float = field(unit="m", doc="gripper joint position to go to")
    force: float = field(unit="N", doc="largest gripper force")
    payload_mass: float = field(
        unit="kg", doc="mass in the gripper, which `inertia` and `load` include"
    )
    payload_offset: ndarray = field(unit="m", doc="its centre, in the frame of the tool", shape=3)


class JointTorque(SampledCommand, version=1):
    """Sent by a board that servoes joints to the board of the arm, which adds them up.

    The id rises with every cycle.
    """

    sampled: int = field(
        unit="tick",
        doc="tick of the arm's status on which the torque is based, or -1 before the first",
    )
    torque: ndarray = joint_field("N m", "of the board's own joints; others 0")
    target: ndarray = joint_field(
        "rad", "where the board wants its own joints when the torque acts; others 0"
    )
    target_velocity: ndarray = joint_field("rad/s", "likewise")
    grip_force: float = field(
        unit="N", doc="of the gripper, from the board that drives it; others 0"
    )
    payload_mass: float = field(
        unit="kg", doc="mass in the gripper, from the board that drives it; others 0"
    )
    payload_offset: ndarray = field(unit="m", doc="its centre, in the frame of the tool", shape=3)


class JointStatus(AnsweringStatus, version=1):
    """Sent by a board that servoes joints to the trajectory level."""

    position: ndarray = joint_field("rad", "joint positions, from the arm's status")
    target: ndarray = joint_field(
        "rad", "set point of the board's own joints in this cycle; others 0"
    )
    target_velocity: ndarray = joint_field("rad/s", "likewise")
    torque: ndarray = joint_field("N m", "of the board's own joints; others 0")
    driven: ndarray = field(
        "u1", unit="1", doc="1: the joint is one of this board's", shape="joints"
    )
    holding: bool = field(doc="1: no fresh set point, the joints ramp to rest and stay")
    stopped: bool = field(doc="1: set points are not followed: an operator, or the arm is braked")
    due: int = field(unit="tick", doc="due tick of the newest set point taken over, or 0")


class SensedStatus(AnsweringStatus):
    """Status with the tick at which an arm was sensed."""

    tick: int = field(unit="tick", doc="tick at which the arm was sensed")


class ArmStatus(SensedStatus, DrivenArm, version=2):
    """Sent by the board of the arm to the boards that servo joints.

    It is the status of a servo level without set points.
    """


DRIVING = (ServoStatus.message_type.name, ArmStatus.message_type.name)
"""Names of the statuses of levels that drive an arm."""
STREAMED = (
    JointCommand.message_type.name,
    JointReference.message_type.name,
    JointTorque.message_type.name,
)
"""Names of commands that change in every cycle."""
