"""Preparation of a model for the servo level: motors, integrator, time step, tool, keyframe."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import mujoco
import numpy as np

from rack.levels.algebra import Array
from rack.levels.errors import RobotError
from rack.levels.robot.engine import SLEEP
from rack.levels.robot.model_file import ModelReader
from rack.levels.tables import (
    MAX_JOINTS,
    MAX_VALUE,
    FollowConfig,
    GripperConfig,
    RobotConfig,
    ToolConfig,
)

MAX_STEP_S = 0.1
"""Maximum time step of an MJCF file. A longer one is a mistake, such as ms for s."""
JOINT_DRIVES = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
SET_POINT_ROWS = 3
"""Number of values per joint in MuJoCo's user data for drives that follow set points.

They are position, velocity, and the torque of the integral.
"""
SCALAR_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
# MuJoCo would print its warnings, and write them to a file in the working directory. Code that
# needs to know of a warning reads its counters instead, as the steps of the simulation do.
mujoco.set_mju_user_warning(lambda _: None)


def load_spec(path: Path) -> mujoco.MjSpec:
    """Parse an MJCF file, without compiling it.

    Raises:
        RobotError: `ModelReader` or MuJoCo refuses the file, or its time step is invalid.
    """
    texts = ModelReader(path).texts
    try:
        spec = mujoco.MjSpec.from_file(str(path.resolve().with_name(next(iter(texts)))), texts)
    except (ValueError, RuntimeError) as problem:
        raise RobotError(f"model '{path}': {format_one_line(problem)}") from None
    step = float(spec.option.timestep)
    if not 0 < step <= MAX_STEP_S:
        raise RobotError(
            f"model '{path}': timestep {step:g} s is invalid; it must be above 0 and at most"
            f" {MAX_STEP_S:g} s"
        )
    return spec


def compile_spec(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    """Compile a model.

    If MuJoCo refuses inertias of bodies that never move, the model is compiled without these
    inertias.

    Raises:
        RobotError: The model cannot be compiled. The text is MuJoCo's reason in one line.
    """
    try:
        return spec.compile()
    except (ValueError, RuntimeError, mujoco.FatalError) as problem:
        if drop_fixed_inertias(spec.worldbody):
            return compile_spec(spec, path)
        raise RobotError(f"model '{path}': {format_one_line(problem)}") from None


def drop_fixed_inertias(body: mujoco.MjsBody) -> bool:
    """Remove explicit inertias from all descendants of `body` that no joint moves.

    Returns:
        True if any was removed.
    """
    is_dropped = False
    # Do not iterate over the lists of a body: they raise the error of a failed compilation again.
    child = body.first_body()
    while child is not None:
        if child.first_joint() is None:
            is_dropped |= drop_fixed_inertias(child) or bool(child.explicitinertial)
            child.explicitinertial = False
            child.fullinertia = np.full(6, np.nan)
            child.inertia = np.zeros(3)
        child = body.next_body(child)
    return is_dropped


def check_joint_count(joints: Sequence[str]) -> None:
    """Check that an arm does not have too many joints.

    Raises:
        RobotError: There are more than `MAX_JOINTS`.
    """
    if len(joints) > MAX_JOINTS:
        raise RobotError(
            f"an arm has at most {MAX_JOINTS} joints, not {len(joints)}: {format_names([*joints])};"
            " name fewer in robot.joints, or by --tip or --joints of 'rack robot new'"
        )


def check_joints(robot: RobotConfig, spec: mujoco.MjSpec) -> None:
    """Check that the model has the arm's joints, and that each is scalar.

    Raises:
        RobotError: A joint is missing or not scalar.
    """
    for name in robot.joints:
        joint = spec.joint(name)
        if joint is None:
            have = format_names([j.name for j in spec.joints])
            raise RobotError(f"robot.joints: no joint '{name}' in the model; it has: {have}")
        if joint.type not in SCALAR_JOINTS:
            kind = joint.type.name.removeprefix("mjJNT_").lower()
            raise RobotError(f"robot.joints: '{name}' is a {kind} joint, must be hinge or slide")


def prepare_spec(spec: mujoco.MjSpec, robot: RobotConfig, clock_ns: int) -> None:
    """Prepare a model for the servo level.

    Sets integrator, time step, drive inertia, tool, gripper and keyframe.

    Args:
        spec: The model, which is changed.
        robot: The `[robot]` table.
        clock_ns: Duration of a tick, ns.
    """
    option = spec.option
    option.timestep = clock_ns * 1e-9 / robot.substeps
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # An automatic reset to t = 0 would hide an invalid state.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    option.enableflags &= ~SLEEP
    for name in robot.joints:
        joint = spec.joint(name)
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            joint.armature = max(joint.armature, robot.min_armature)
    tool = robot.tool_offset or ToolConfig()
    carrier = spec.body(robot.tool)
    if spec.site(robot.tool_name) is None and carrier is not None:
        carrier.add_site(name=robot.tool_name, pos=tool.position, quat=tool.quaternion)
    for first, second in robot.exclude:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    if robot.gripper is not None:
        fit_gripper(spec, robot.gripper)
    if robot.interface != "torque":
        spec.nuserdata += SET_POINT_ROWS * len(robot.joints)
    # The controls in keyframes belong to actuators that were replaced.
    for key in list(spec.keys):
        spec.delete(key)
    spec.add_key(name="start")


def fit_motors(spec: mujoco.MjSpec, robot: RobotConfig) -> tuple[list[str], Array]:
    """Replace the drives of the arm's joints in `spec` by torque motors.

    A torque limit comes from `robot.torque`. Otherwise it is the tightest of the joint's
    actuatorfrcrange and the ranges of its actuators.

    Returns:
        Names of the motors, and torque limits, (joints,), N m.

    Raises:
        RobotError: Neither config nor model has a limit, or joints share an actuator.
    """
    drives = [a for a in spec.actuators if is_arm_drive(spec, a, robot)]
    tendons = [a for a in drives if a.trntype not in JOINT_DRIVES]
    shared = {*robot.joints} - {a.target for a in drives}
    shared &= {joint for a in tendons for joint in find_driven_joints(spec, a)}
    if len(shared) > len(tendons):
        raise RobotError(
            f"joints {format_names(sorted(shared))} share one actuator, but joints of an "
            "arm are driven"
            " independently; give each a separate actuator"
        )
    limits = robot.torque or tuple(find_torque_limit(spec, name, drives) for name in robot.joints)
    if 0.0 in limits:
        raise RobotError(
            f"joint '{robot.joints[limits.index(0.0)]}': the model has no torque limit; set"
            " robot.torque, N m, one value per joint"
        )
    remove_actuators(spec, drives)
    names = [f"torque of {joint}" for joint in robot.joints]
    for name, joint, limit in zip(names, robot.joints, limits, strict=True):
        drive = spec.joint(joint)
        drive.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        # With actgravcomp the motor would carry a torque that was not commanded, whereas a passive
        # force is part of the model's bias.
        drive.actgravcomp = False
        add_motor(spec, name, mujoco.mjtTrn.mjTRN_JOINT, joint, limit)
    return names, np.array(limits)


def fit_gripper(spec: mujoco.MjSpec, gripper: GripperConfig) -> None:
    """Replace the gripper's actuator by a force motor on the same joint or tendon.

    The force of the motor is limited to `gripper.force`. Joints in `gripper.follow` are coupled to
    the driven joint.

    Raises:
        RobotError: The model has no such actuator, or it drives neither a joint nor a tendon.
    """
    old = spec.actuator(gripper.actuator)
    if old is None:
        have = format_names([a.name for a in spec.actuators])
        raise RobotError(
            f"robot.gripper.actuator: '{gripper.actuator}' is not in the model; it has: {have}"
        )
    kind = old.trntype
    target = old.target
    if kind not in (*JOINT_DRIVES, mujoco.mjtTrn.mjTRN_TENDON):
        raise RobotError(
            f"robot.gripper.actuator: '{gripper.actuator}' is a {kind.name}; it must be on a joint"
            " or tendon"
        )
    remove_actuators(spec, [old])
    add_motor(spec, gripper.actuator, kind, target, gripper.force)
    for follower in gripper.follow:
        couple_joint(spec, gripper, follower)


def couple_joint(spec: mujoco.MjSpec, gripper: GripperConfig, follower: FollowConfig) -> None:
    """Make a joint follow the gripper's driven joint, and remove its actuators.

    Args:
        spec: The model, which is changed.
        gripper: The `[robot.gripper]` table.
        follower: The joint.

    Raises:
        RobotError: A joint is missing, or it is the driven joint.
    """
    for name in (follower.joint, gripper.joint):
        if spec.joint(name) is None:
            have = format_names([j.name for j in spec.joints])
            raise RobotError(f"robot.gripper: no joint '{name}' in the model; it has: {have}")
    if follower.joint == gripper.joint:
        raise RobotError(f"robot.gripper.follow: '{follower.joint}' is the driven joint itself")
    drives = [a for a in spec.actuators if a.trntype in JOINT_DRIVES and a.target == follower.joint]
    if any(a.name == gripper.actuator for a in drives):
        raise RobotError(
            f"robot.gripper.follow: '{follower.joint}' is driven by the gripper's actuator"
        )
    remove_actuators(spec, drives)
    equality = spec.add_equality(name=f"{follower.joint} follows {gripper.joint}")
    equality.type = mujoco.mjtEq.mjEQ_JOINT
    equality.name1 = follower.joint
    equality.name2 = gripper.joint
    equality.data[:2] = [0.0, follower.ratio]
    # This is as stiff as a gear. With the default values a finger lags by millimetres.
    equality.solref = [0.002, 1.0]
    equality.solimp[:3] = [0.99, 0.999, 0.001]


def is_arm_drive(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator, robot: RobotConfig) -> bool:
    """Return True if an actuator drives a joint of the arm, directly or by a fixed tendon."""
    return not {*robot.joints}.isdisjoint(find_driven_joints(spec, actuator))


def find_driven_joints(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator) -> list[str]:
    """Return the joints that an actuator drives, directly or through a fixed tendon."""
    if actuator.trntype in JOINT_DRIVES:
        return [actuator.target]
    is_tendon = actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON
    tendon = spec.tendon(actuator.target) if is_tendon else None
    path = () if tendon is None else tendon.path
    return [wrap.target.name for wrap in path if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT]


def find_torque_limit(
    spec: mujoco.MjSpec, joint: str, drives: Iterable[mujoco.MjsActuator]
) -> float:
    """Return the tightest torque limit, in N m, that a model contains for a joint.

    The result is 0 if the model contains none, or only values that a `[robot]` table must not have,
    such as infinity.

    Args:
        spec: The model.
        joint: Name of the joint.
        drives: Actuators of the arm.
    """
    element = spec.joint(joint)
    limits = [compute_symmetric_range(element.actfrclimited, element.actfrcrange)]
    limits += [
        compute_drive_limit(a) for a in drives if a.trntype in JOINT_DRIVES and a.target == joint
    ]
    return min((x for x in limits if 0 < x < MAX_VALUE), default=0.0)


def compute_drive_limit(actuator: mujoco.MjsActuator) -> float:
    """Return the torque limit that an actuator on a joint implies, in N m, or 0 if it has none."""
    gear = abs(float(actuator.gear[0]))
    limits = [compute_symmetric_range(actuator.forcelimited, actuator.forcerange) * gear]
    if (
        actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE
        and actuator.biastype == mujoco.mjtBias.mjBIAS_NONE
        and actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
    ):
        limits.append(
            compute_symmetric_range(actuator.ctrllimited, actuator.ctrlrange)
            * abs(float(actuator.gainprm[0]))
            * gear
        )
    return min((x for x in limits if x > 0), default=0.0)


def compute_symmetric_range(limited: mujoco.mjtLimited, span: Array) -> float:
    """Return the largest x for which -x to x is within `span`.

    Return 0 if there is no limit, or no such x.
    """
    if limited == mujoco.mjtLimited.mjLIMITED_FALSE or not span[0] < span[1]:
        return 0.0
    return max(0.0, min(-float(span[0]), float(span[1])))


def add_motor(
    spec: mujoco.MjSpec, name: str, kind: mujoco.mjtTrn, target: str, limit: float
) -> None:
    """Add a motor of gear 1 whose control is its force or torque.

    Args:
        spec: The model, which is changed.
        name: Name of the motor.
        kind: Kind of the target.
        target: Joint or tendon that it drives.
        limit: Largest force or torque in both directions, N or N m.
    """
    motor = spec.add_actuator(name=name, trntype=kind, target=target)
    motor.set_to_motor()
    motor.ctrllimited = motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    motor.ctrlrange = motor.forcerange = [-limit, limit]


def remove_actuators(spec: mujoco.MjSpec, actuators: list[mujoco.MjsActuator]) -> None:
    """Remove actuators and the sensors on them."""
    names = {a.name for a in actuators}
    for sensor in list(spec.sensors):
        if sensor.objtype == mujoco.mjtObj.mjOBJ_ACTUATOR and sensor.objname in names:
            spec.delete(sensor)
    for actuator in actuators:
        spec.delete(actuator)


def format_one_line(problem: Exception) -> str:
    """Return the message of a MuJoCo error as one line."""
    return " ".join(str(problem).split()).removeprefix("Error: ")


def format_names(names: list[str], most: int = 24) -> str:
    """Return a comma-separated list of names for an error message, with at most `most` names."""
    named = [n for n in names if n]
    more = f" and {len(named) - most} more" if len(named) > most else ""
    return (", ".join(named[:most]) or "none") + more
