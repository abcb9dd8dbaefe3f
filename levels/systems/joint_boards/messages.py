"""The messages between a trajectory level, the boards that servo joints, and the board of the arm.

Every vector has all joints of the arm; a board of some joints fills and obeys its own. Symbolic
sizes as in `rack.levels.messages`.

A level of your own that servoes joints
- names them in its parameter `joints` (without one: all), and says with `gripper = true` that it
  drives the gripper.
- writes a `JOINT_TORQUE` in every cycle, for the moment when it acts: a cycle after the release.
  `sampled` shows the arm which of its statuses the torque rests on; one that is too old brakes it.
- wants its joints where they are while the arm says `braked`: only then is it released. While it
  only says `stopped`, brings them to rest and holds them; an arm that still moves after the time
  that this takes is braked.

A level of your own above these reports no set point (`due = 0`) while one of them is `stopped`, and
begins again where they hold the arm.
"""

from __future__ import annotations

from rack.backplane.message import command, status
from rack.levels.fields import by_joint, flag, real, tick
from rack.levels.messages import DRIVEN_ARM, JOINT_SET_POINT, SERVO_STATUS
from rack.levels.operator import ANSWER, RESTS_ON

JOINT_REFERENCE = command(
    "joint_reference",
    1,
    RESTS_ON,
    tick("due", "tick at which the arm should be there; 0: no set point, hold"),
    by_joint("position", "rad", "joint positions"),
    by_joint("velocity", "rad/s", "joint velocities"),
    by_joint("acceleration", "rad/s2", "joint accelerations"),
    by_joint("inertia", "kg m2", "diagonal of the joint-space inertia there"),
    by_joint("load", "N m", "torques of gravity and motion there, without acceleration"),
    real("opening", "m", "gripper joint position to go to"),
    real("force", "N", "largest gripper force"),
    real("payload_mass", "kg", "mass in the gripper, which `inertia` and `load` include"),
    real("payload_offset", "m", "its centre, in the frame of the tool", 3),
)
"""From the trajectory level to all boards that servo joints; these interpolate between its set
points."""

JOINT_TORQUE = command(
    "joint_torque",
    1,
    RESTS_ON,
    tick("sampled", "tick of the arm's status that it rests on; -1: none yet, so no torque"),
    by_joint("torque", "N m", "of the board's own joints; others 0"),
    by_joint(
        "target", "rad", "where the board wants its own joints when the torque acts; others 0"
    ),
    by_joint("target_velocity", "rad/s", "likewise"),
    real("grip_force", "N", "of the gripper, from the board that drives it; others 0"),
    real("payload_mass", "kg", "mass in the gripper, from the board that drives it; others 0"),
    real("payload_offset", "m", "its centre, in the frame of the tool", 3),
)
"""From a board that servoes joints to the board of the arm, which adds them up; id rises with every
cycle."""

JOINT_STATUS = status(
    "joint_status",
    1,
    *ANSWER,
    by_joint("position", "rad", "joint positions, from the arm's status"),
    by_joint("target", "rad", "set point of the board's own joints in this cycle; others 0"),
    by_joint("target_velocity", "rad/s", "likewise"),
    by_joint("torque", "N m", "of the board's own joints; others 0"),
    flag("driven", "1: the joint is one of this board's", "joints"),
    flag("holding", "1: no fresh set point, the joints ramp to rest and stay"),
    flag("stopped", "1: set points are not followed: an operator, or the arm is braked"),
    tick("due", "newest set point taken over; 0: none"),
)
"""From a board that servoes joints to the trajectory level."""

ARM_STATUS = status(
    "arm_status",
    2,
    *ANSWER,
    tick("tick", "tick at which the arm was sensed"),
    *DRIVEN_ARM,
)
"""From the board of the arm to those that servo joints; a servo level's status without set points
of its own."""

DRIVING = (SERVO_STATUS.name, ARM_STATUS.name)
"""Names of the statuses of levels that drive an arm."""
STREAMED = (JOINT_SET_POINT.name, JOINT_REFERENCE.name, JOINT_TORQUE.name)
"""Names of commands that change in every cycle."""
