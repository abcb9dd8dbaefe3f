"""A hand: fingers whose joints are driven by pairs of tendons, from `[robot.hand]` and its model.

The control of a tendon's actuator is its tension. A positive tension shortens the tendon, and it
cannot be negative: a tendon can only pull. The two tendons of a joint pull in opposite directions,
with equal and constant moment arms, and turn no other joint: torque = arm (tension of flexor -
tension of extensor).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from rack.levels.algebra import Array, Ints, Mask
from rack.levels.errors import RobotError
from rack.levels.robot import lookup
from rack.levels.robot.model import is_arm_drive, remove_actuators
from rack.levels.tables import FingerConfig, HandConfig, RobotConfig

ARM_TOLERANCE = 1e-6
"""Fraction by which a moment arm may vary, to allow for rounding."""
ROWS = ("flexors", "extensors")
NET_FORCE = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3, 1
"""Parameters of a contact sensor that measures the net force of all contacts."""


@dataclass(frozen=True)
class Hand:
    """The hand of a cell.

    Joints are in the order of `robot.joints`. An array with two rows has flexors in the first row
    and extensors in the second.
    """

    names: tuple[str, ...]  # names of the fingers
    tips: Ints  # (fingers,), sites at their tips
    # (fingers, 3), addresses in sensordata of the force on the body of the tip, in the world frame.
    forces: Ints
    fingers: Mask  # (fingers, joints), True where a joint belongs to the finger
    actuators: Ints  # (2, joints), addresses of the tendons in ctrl
    arms: Array  # (joints,), m: moment arm of both tendons of a joint, positive
    least: float  # N: tension below which a tendon is slack
    rest: float  # N: mean tension of a pair at rest
    most: Array  # (joints,), N: largest tension of either tendon
    closed: float  # N/m: stiffness of a slack tendon whose valve is closed
    stiffening: float  # 1/N: fraction by which tension raises that stiffness

    @property
    def torque(self) -> Array:
        """Largest torque of each joint in both directions, (joints,), in N m.

        A joint has this torque if one tendon has its largest tension, and the other the least.
        """
        return np.asarray(self.arms * self.most - self.arms * self.least)


def check_hand(robot: RobotConfig, hand: HandConfig) -> None:
    """Check `[robot.hand]` without the model: lengths of lists, joints of fingers, tensions.

    Raises:
        RobotError: The table is invalid.
    """
    if robot.gripper is not None:
        raise RobotError("robot.hand: a hand has no gripper; remove robot.gripper")
    if robot.torque is not None:
        raise RobotError("robot.torque: torques of a hand follow from its tendons; remove the key")
    for row in ROWS:
        names = getattr(hand, row)
        if len(names) != len(robot.joints):
            raise RobotError(
                f"robot.hand.{row}: has {len(names)} values but needs {len(robot.joints)},"
                " one per joint"
            )
    joints = [joint for finger in hand.finger for joint in finger.joints]
    for key, named in (
        ("", hand.flexors + hand.extensors),
        (".finger.name", [finger.name for finger in hand.finger]),
        (".finger.joints", joints),
    ):
        if repeated := {name for name in named if named.count(name) > 1}:
            raise RobotError(f"robot.hand{key}: '{min(repeated)}' is named more than once")
    if strays := {*joints} ^ {*robot.joints}:
        raise RobotError(
            f"robot.hand.finger.joints: '{min(strays)}' must be in robot.joints and of a finger"
        )
    if not hand.least < hand.rest:
        raise RobotError(
            f"robot.hand.rest: {hand.rest:g} N must be above robot.hand.least, {hand.least:g} N"
        )


def fit_tendons(
    spec: mujoco.MjSpec, robot: RobotConfig, hand: HandConfig, step_s: float
) -> tuple[list[str], Array]:
    """Prepare the model of a hand, so that only the tendons drive its joints.

    Each fingertip gets a force sensor. Actuators with a delay get memory for the delayed controls.

    Args:
        spec: The model, which is changed.
        robot: The `[robot]` table.
        hand: The `[robot.hand]` table.
        step_s: Time step of the simulation, s.

    Returns:
        Names of the flexors, and infinite torque limits, (joints,), N m. The limits are known only
        after the model is compiled: see `Hand.torque`.
    """
    check_hand(robot, hand)
    tendons = hand.flexors + hand.extensors
    remove_actuators(
        spec, [a for a in spec.actuators if a.name not in tendons and is_arm_drive(spec, a, robot)]
    )
    for name in robot.joints:
        joint = spec.joint(name)
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.actgravcomp = False
    for actuator in spec.actuators:
        if actuator.delay > 0.0:
            actuator.nsample = max(actuator.nsample, math.ceil(actuator.delay / step_s) + 1)
    for finger in hand.finger:
        site = spec.site(finger.tip)
        if site is not None:
            site.parent.name = site.parent.name or f"tip of {finger.name}"
            sensor = spec.add_sensor(
                name=_name_force_sensor(finger),
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                reftype=mujoco.mjtObj.mjOBJ_BODY,
                refname=site.parent.name,
            )
            sensor.intprm[:3] = NET_FORCE
    return list(hand.flexors), np.full(len(robot.joints), np.inf)


def _name_force_sensor(finger: FingerConfig) -> str:
    """Return the name of the force sensor at the tip of a finger."""
    return f"force on {finger.name}"


def find_hand(model: mujoco.MjModel, robot: RobotConfig, hand: HandConfig) -> Hand:
    """Find all elements that `[robot.hand]` names in the compiled model, and return the hand.

    Args:
        model: The compiled model.
        robot: The `[robot]` table.
        hand: The `[robot.hand]` table.

    Raises:
        RobotError: An element is missing or unsuitable.
    """
    kind = mujoco.mjtObj
    actuators = np.stack(
        [
            lookup.find_all(model, kind.mjOBJ_ACTUATOR, getattr(hand, r), f"robot.hand.{r}")
            for r in ROWS
        ]
    )
    sites = tuple(finger.tip for finger in hand.finger)
    tips = lookup.find_all(model, kind.mjOBJ_SITE, sites, "robot.hand.finger.tip")
    for finger, tip in zip(hand.finger, tips, strict=True):
        if not lookup.mark_descendants(
            model, model.jnt_bodyid[[model.joint(finger.joints[-1]).id]]
        )[model.site_bodyid[tip]]:
            raise RobotError(
                f"robot.hand.finger: joint '{finger.joints[-1]}' does not move the tip"
                f" '{finger.tip}'"
            )
    check_tensions(model, actuators, hand.least)
    most = model.actuator_ctrlrange[actuators, 1]
    for joint, (first, second) in zip(robot.joints, most.T, strict=True):
        if first != second:
            raise RobotError(
                f"robot.hand: tendons of joint '{joint}' pull at most {first:g} and {second:g} N;"
                " both must be equal"
            )
    if not hand.rest < most.min():
        raise RobotError(
            f"robot.hand.rest: {hand.rest:g} N must be below the largest tension, {most.min():g} N"
        )
    return Hand(
        names=tuple(finger.name for finger in hand.finger),
        tips=tips,
        fingers=np.array(
            [[joint in finger.joints for joint in robot.joints] for finger in hand.finger]
        ),
        forces=np.array(
            [
                model.sensor(_name_force_sensor(finger)).adr[0] + np.arange(3)
                for finger in hand.finger
            ]
        ),
        actuators=actuators,
        arms=_find_moment_arms(model, robot, actuators),
        least=hand.least,
        rest=hand.rest,
        most=np.array(most[0]),
        closed=hand.closed,
        stiffening=hand.stiffening,
    )


def check_tensions(model: mujoco.MjModel, actuators: Ints, least: float) -> None:
    """Check that the control of each actuator is the tension of a tendon in N.

    Args:
        model: The compiled model.
        actuators: The actuators.
        least: Tension that every actuator must be able to exceed, N.

    Raises:
        RobotError: An actuator does anything other than pull one tendon.
    """
    low, high = np.moveaxis(model.actuator_ctrlrange[actuators], -1, 0)
    pulls = (
        (model.actuator_trntype[actuators] == mujoco.mjtTrn.mjTRN_TENDON)
        & (model.actuator_gaintype[actuators] == mujoco.mjtGain.mjGAIN_FIXED)
        & (model.actuator_gainprm[actuators, 0] == 1.0)
        & (model.actuator_biastype[actuators] == mujoco.mjtBias.mjBIAS_NONE)
        & (model.actuator_gear[actuators, 0] == -1.0)
        & (model.actuator_ctrllimited[actuators] != 0)
        & (low >= 0.0)
        & (high > least)
    )
    for actuator in actuators[~pulls]:
        raise RobotError(
            f"robot.hand: actuator '{model.actuator(int(actuator)).name}' must pull one tendon,"
            " with its control as tension, N: it needs a fixed gain of 1, no bias, a gear of -1,"
            f" and a range from 0 or more to above robot.hand.least = {least:g} N"
        )


def _find_moment_arms(model: mujoco.MjModel, robot: RobotConfig, actuators: Ints) -> Array:
    """Return the moment arm of the two tendons of each joint, (joints,), in m.

    Raises:
        RobotError: The two tendons of a joint do not pull in opposite directions with equal,
            constant moment arms, or they turn another joint.
    """
    joints = np.array([model.joint(name).id for name in robot.joints])
    home = np.array(robot.home)
    ranges = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], home[:, None])
    places = (home, *ranges.T)
    moments = np.array([compute_moments(model, joints, place)[actuators] for place in places])
    # (places, 2, joints), m: moment arms of flexors, and of extensors with the sign reversed.
    arms = np.diagonal(moments, axis1=2, axis2=3) * np.array([[1.0], [-1.0]])
    others = np.abs(moments * (1.0 - np.eye(len(joints)))).max(axis=(0, 1, 3))
    least = arms.min(axis=(0, 1)) + 0.0  # avoids -0
    peak = arms.max(axis=(0, 1))
    for joint, low, high, other in zip(robot.joints, least, peak, others, strict=True):
        if low < ARM_TOLERANCE or max(high - low, other) > ARM_TOLERANCE * low:
            raise RobotError(
                f"robot.hand: arms of the tendons on joint '{joint}' are {low:g} to {high:g} m,"
                f" and on others up to {other:g} m; the flexor must turn it alone in positive"
                " direction and the extensor in negative direction, with equal arms that do not"
                " vary"
            )
    return np.array(arms[0, 1])


def compute_moments(model: mujoco.MjModel, joints: Ints, position: Array) -> Array:
    """Return the moment arms of all actuators on the given joints, (actuators, joints), in m.

    Args:
        model: The compiled model.
        joints: Ids of the joints.
        position: Positions of these joints, rad.
    """
    data = mujoco.MjData(model)
    moments = np.zeros((model.nu, model.nv))
    data.qpos[model.jnt_qposadr[joints]] = position
    mujoco.mj_fwdPosition(model, data)
    mujoco.mju_sparse2dense(
        moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
    )
    return np.asarray(moments[:, model.jnt_dofadr[joints]])
