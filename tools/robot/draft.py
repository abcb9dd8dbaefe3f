"""Drafts a `[robot]` table from a model file, and names every value that is a guess.

`_run_steps` runs the steps. Each returns one record: limits, gripper, tool, overlaps, home.
`Draft.table` composes them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from pydantic import ValidationError

from rack.levels.algebra import Array
from rack.levels.errors import RobotError
from rack.levels.planning.collision import CollisionChecker
from rack.levels.planning.ik import find_sampling_range
from rack.levels.robot.abilities import Statics
from rack.levels.robot.cell import (
    Cell,
    build_cell,
    build_unchecked_cell,
    check_fingers,
    find_unintended_contacts,
)
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.engine import set_margins
from rack.levels.robot.linkage import check_couplings
from rack.levels.robot.model import compile_spec, find_torque_limit, format_names, load_spec
from rack.levels.servo.control import LoopGains
from rack.levels.tables import GripperConfig, RobotConfig, SceneConfig, ToolConfig
from rack.tools.robot.arm import ArmParts, find_arm, find_driven_joints, fix_joints
from rack.tools.robot.fingertips import Fingertips, choose_outward_tool, measure_fingertips
from rack.tools.robot.gripper import fit_gripper
from rack.tools.robot.pieces import cut_meshes
from rack.tools.robot.source import Source, copy_model

CLOCK_NS = 2_500_000
"""Clock period of `nasrem`, whose levels and boards the arm gets."""
GUESSED_SPEED = {mujoco.mjtJoint.mjJNT_HINGE: 1.5, mujoco.mjtJoint.mjJNT_SLIDE: 0.25}
"""Guessed velocity limits of each joint type, in rad/s and m/s."""
SPEED_UP_S = 0.5
"""Time to full speed of planned motion, if the motors permit.

The jerk limit is ten times the acceleration limit.
"""
MIN_SPARE_TORQUE = 0.2
"""Fraction of each torque limit that must be left over at home after gravity."""
TORQUE_MARGIN = 2.0
"""Guessed torque limits, as a multiple of the torque for weight, friction and acceleration."""
MAX_DRAG_FRACTION = 0.4
"""Fraction of the torque left over by gravity that friction may take at a guessed velocity."""
MAX_REST_ERROR_RAD = 0.002
"""Largest error at which dry friction may hold a joint at rest. Tasks permit 0.003 rad."""
MAX_BANDWIDTH = 100.0
"""Upper bound for the bandwidth of the joint loop in rad/s."""
POSE_COUNT = 400
"""Number of poses that are sampled."""
CONTACT_DISTANCE_M = 1e-4
"""Distance in m below which bodies count as touching, because the planner rejects such poses."""
PREFERRED_CLEARANCE_M = 0.005
"""Preferred clearance at home in m, because a linkage settles slightly off its equalities."""
OVERLAP_FRACTION = 0.95
"""Bodies in contact in this fraction of the poses are neighbours whose shapes overlap."""
TOOL_NAMES = ("tcp", "tool", "grip_site", "attachment", "eef", "ee_", "pinch", "hand", "flange")
"""Name parts of frames at the end of an arm, in order of preference."""
EMPTY_SCENE = SceneConfig()
"""A scene without objects or supports."""


@dataclass(frozen=True)
class ArmOptions:
    """Options that the user gave. For an empty option, `draft_arm` chooses a value."""

    tip: str = ""
    joints: tuple[str, ...] = ()
    tool: str = ""
    gripper: str = ""
    home: str = ""
    torque: tuple[float, ...] = ()


class FittedGripper(NamedTuple):
    """A usable gripper, and the measurements of its fingers."""

    config: GripperConfig
    fingertips: Fingertips
    guess: str
    notes: list[str]


class ToolFrame(NamedTuple):
    """Frame of the tool: a body or site of the model, and a pose relative to it."""

    name: str
    offset: ToolConfig | None = None
    guess: str = ""


class HomePose(NamedTuple):
    """Position to which tasks return."""

    position: list[float]  # (joints,), rad
    guess: str = ""


@dataclass(frozen=True)
class JointLimits:
    """Limits of the joints, base to tool. All lists have one value per joint."""

    velocity: list[float]  # rad/s
    acceleration: list[float]  # rad/s2
    jerk: list[float]  # rad/s3
    torque: list[float]  # N m
    unstated: list[str]  # joints whose velocity the model does not state
    is_torque_stated: list[bool]
    bandwidth: float | None = None  # of the joint loop, rad/s; None for the default of `nasrem`
    friction_error: float = 0.0  # rad: rest error from dry friction with the default bandwidth


@dataclass
class Draft:
    """A drafted arm, with one record from each step of `_run_steps`.

    `table` combines the records into the `[robot]` table.
    """

    model: Path  # MJCF file of the draft
    spec: mujoco.MjSpec  # content of that file, possibly with changes not yet written
    options: ArmOptions
    arm: ArmParts
    keyframes: Mapping[str, Array]  # positions of the arm's joints, (joints,), by name
    notes: list[str]
    limits: JointLimits
    tool: ToolFrame
    home: HomePose
    gripper: FittedGripper | None = None
    exclude: tuple[tuple[str, str], ...] = ()

    @property
    def table(self) -> dict[str, Any]:
        """The `[robot]` table, composed of the records found so far."""
        table = {
            "model": self.model,
            "joints": self.arm.joints,
            "tool": self.tool.name,
            "home": self.home.position,
            "velocity": self.limits.velocity,
            "acceleration": self.limits.acceleration,
            "jerk": self.limits.jerk,
            "torque": self.limits.torque,
            "gripper": self.gripper and self.gripper.config,
            "tool_offset": self.tool.offset,
            "exclude": self.exclude,
        }
        return {key: value for key, value in table.items() if value}

    @property
    def guessed(self) -> dict[str, str]:
        """Dictionary from each key whose value is a guess to the reason for the guess."""
        limits = self.limits
        torque = f"{TORQUE_MARGIN:g} times what weight, friction and inertia take"
        reasons = {
            "velocity": limits.unstated
            and f"the model states none for {format_names(limits.unstated)}",
            "gripper": self.gripper and self.gripper.guess,
            "tool": self.tool.guess,
            "exclude": self.exclude and "these bodies overlap in every pose",
            "torque": not all(limits.is_torque_stated) and torque,
            "acceleration": "by the torques",
            "jerk": "by the torques",
            "home": self.home.guess,
        }
        return {key: str(reason) for key, reason in reasons.items() if reason}

    @property
    def robot(self) -> RobotConfig:
        """The validated table. Raises `RobotError` if a value is invalid."""
        try:
            return RobotConfig(**self.table, guessed=tuple(self.guessed))
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(map(str, first["loc"]))
            raise RobotError(f"robot.{key} = {first['input']}: {first['msg'].lower()}") from None

    def build_cell(self, scene: SceneConfig = EMPTY_SCENE, **changes: Any) -> Cell:
        """Build the cell of the arm as drafted so far.

        Keyword arguments override keys of the table. Raises `RobotError` if the cell is invalid.
        """
        return build_unchecked_cell(self.robot.model_copy(update=changes), scene, CLOCK_NS)

    def write_model(self) -> None:
        """Write the model to its file. Raises `RobotError` if it cannot be compiled."""
        compile_spec(self.spec, self.model)
        self.model.write_text(self.spec.to_xml(), encoding="utf-8")


def draft_arm(source: Source, options: ArmOptions, folder: Path, name: str) -> Draft:
    """Draft the arm of a model such that `rack run` accepts it.

    A gripper that `rack run` would refuse is fixed in place instead of driven.

    Args:
        source: The user's model.
        options: Options that the user gave.
        folder: Folder to which the draft's model is written.
        name: Name of that model file, without suffix.

    Raises:
        RobotError: No arm can be drafted from the model. The message is one line.
    """
    try:
        result = _run_steps(source, options, folder, name)
    except RobotError as error:
        raise RobotError("; ".join([str(error), *source.notes])) from None
    try:
        build_cell(result.robot, EMPTY_SCENE, CLOCK_NS)
    except RobotError as error:
        if result.gripper is None:
            raise
        result = _run_steps(source, replace(options, gripper="none"), folder, name)
        result.notes.append(f"no gripper: {error}")
    return result


def _run_steps(source: Source, options: ArmOptions, folder: Path, name: str) -> Draft:
    """Run the steps of a draft. Each computes a record from the draft so far."""
    model = source.compile_model()
    arm = find_arm(model, options.tip, options.joints)
    # Fixing a joint also removes its equalities, so check the couplings first.
    check_couplings(model, arm.joints, of_bodies=False)
    addresses = [model.joint(joint).qposadr[0] for joint in arm.joints]
    keyframes = {
        model.key(k).name or f"key {k}": model.key_qpos[k][addresses] for k in range(model.nkey)
    }
    fingers = () if options.gripper == "none" else arm.fingers
    path = folder / f"{name}.xml"
    copy_model(source, path)
    springs = [joint for joint in arm.passive if model.joint(joint).stiffness > 0.0]
    spec = load_spec(path)
    left_out = fix_joints(spec, (*arm.joints, *fingers, *springs))
    notes = [*source.notes, *_describe_omissions(model, arm, left_out)]
    limits = _read_limits(source, model, spec, arm.joints, options.torque)
    tool = ToolFrame(options.tool or _find_mount(compile_spec(spec, path), arm.tip))
    home = HomePose([0.0] * len(arm.joints))
    result = Draft(path, spec, options, arm, keyframes, notes, limits, tool, home)
    result.write_model()
    if fingers:
        try:
            result.gripper = _fit_gripper(result)
            notes += result.gripper.notes
        except RobotError as error:
            notes.append(f"no gripper: {error}")
            fix_joints(spec, arm.joints)
            result.write_model()
    if not options.tool:
        result.tool = _choose_tool(result)
    result.exclude = _find_overlaps(result.build_cell())
    result.limits = limits = _compute_limits(result)
    if limits.bandwidth is not None:
        notes.append(
            f"the joint loop has {limits.bandwidth:g} rad/s: with {LoopGains().bandwidth:g} dry"
            f" friction may hold a joint {1e3 * limits.friction_error:.1f} mrad from its goal"
        )
    result.home = find_home(result)
    return result


def _describe_omissions(model: mujoco.MjModel, arm: ArmParts, left_out: list[str]) -> Iterator[str]:
    """Yield notes for the user about parts that are left out, fixed, or without limits."""
    if left_out:
        yield f"left out, because they are not attached: {format_names(left_out)}"
    if endless := [joint for joint in arm.joints if not model.joint(joint).limited]:
        yield f"joints without limits: {format_names(endless)}; [robot] position can state them"
    if arm.passive:
        yield (
            f"passive joints beyond the arm: {format_names([*arm.passive])}; those "
            "without a spring are"
            " fixed; --joints drives them"
        )
    if arm.others:
        yield (
            f"fixed: other arms that begin at {format_names([*arm.others])}; --tip chooses "
            "one of them"
        )


def _read_limits(
    source: Source,
    model: mujoco.MjModel,
    spec: mujoco.MjSpec,
    joints: Sequence[str],
    wanted: Sequence[float],
) -> JointLimits:
    """Read the limits that the model or the user states, with provisional values for the rest.

    Raises `RobotError` if nothing drives the arm and the user states no torques.
    """
    ids = {model.joint(joint).id for joint in joints}
    if not (wanted or find_driven_joints(model) & ids):
        why = "no actuator and no effort"
        raise RobotError(f"{why} at {format_names([*joints])}; --torque T,... states the limits")
    torque = wanted or [find_torque_limit(spec, joint, spec.actuators) for joint in joints]
    velocity = [
        source.velocity.get(joint, GUESSED_SPEED[spec.joint(joint).type]) for joint in joints
    ]
    return JointLimits(
        *(velocity, velocity, velocity, [limit or 1e6 for limit in torque]),
        unstated=[joint for joint in joints if joint not in source.velocity],
        is_torque_stated=[bool(limit) for limit in torque],
    )


def _find_mount(model: mujoco.MjModel, tip: str) -> str:
    """Find a body fixed to the tip of an arm: one named like a tool, or else the last one."""
    carried = [model.body(tip).id]
    for body in range(carried[0] + 1, model.nbody):
        if model.body_parentid[body] in carried and not model.body_jntnum[body]:
            carried.append(body)
    names = [model.body(body).name for body in carried]
    named = [name for name_part in TOOL_NAMES for name in names[1:] if name_part in name.lower()]
    return str((named or names[-1:])[0])


def _fit_gripper(draft: Draft) -> FittedGripper:
    """Equip the gripper in the draft's model with a single drive, and measure its fingers.

    Raises `RobotError` if the gripper cannot be used.
    """
    wanted = draft.options.gripper
    arm = draft.arm
    if wanted and wanted not in arm.fingers:
        raise RobotError(
            f"--gripper: no joint '{wanted}' beyond the arm; "
            f"{format_names(list(arm.fingers))}, none"
        )
    config, guess = fit_gripper(draft.spec, compile_spec(draft.spec, draft.model), arm, wanted)

    draft.write_model()
    cell = draft.build_cell(gripper=config)
    fingertips = measure_fingertips(cell, arm.tip)
    notes = []
    if fingertips.has_one_finger:
        pieces = cut_meshes(draft.spec, cell, fingertips.out)
        why = f"; their meshes are cut to {pieces} convex pieces" if pieces else ""
        notes.append(f"one finger closes on a fixed jaw{why}")
        draft.write_model()
        fingertips = measure_fingertips(
            draft.build_cell(gripper=config), arm.tip, has_one_finger=True
        )
    config = config.model_copy(update={"open": round(fingertips.opening, 5)})
    cell = draft.build_cell(gripper=config)
    # Home is not known yet, so let the fingers settle without contacts with the rest of the arm.
    is_gripper = np.isin(np.arange(cell.model.ngeom), cell.geoms.gripper)
    cell.model.geom_contype *= is_gripper
    cell.model.geom_conaffinity *= is_gripper
    check_fingers(cell, config)
    return FittedGripper(config, fingertips, guess, notes)


def _choose_tool(draft: Draft) -> ToolFrame:
    """Place the tool between the fingers, or at the end of an arm without a usable gripper."""
    if draft.gripper is None:
        tool = choose_outward_tool(draft.build_cell(), draft.tool.name)
        return ToolFrame(*tool, "z along the last joint, outward")
    fingertips = draft.gripper.fingertips
    sides = "finger and fixed jaw" if fingertips.has_one_finger else "the fingers"
    guess = f"between {sides}, z out of the hand, y across"
    return ToolFrame(draft.arm.tip, fingertips.tool, guess)


def _find_overlaps(cell: Cell) -> tuple[tuple[str, str], ...]:
    """Find pairs of bodies whose shapes overlap in nearly every pose."""
    set_margins(cell.model, CONTACT_DISTANCE_M)
    data = cell.build_start_data()
    count: Counter[tuple[str, str]] = Counter()
    for q in sample_poses(cell):
        count.update(find_touching_bodies(cell, data, q))
    return tuple(sorted(pair for pair, n in count.items() if n >= OVERLAP_FRACTION * POSE_COUNT))


def sample_poses(cell: Cell) -> list[Array]:
    """Sample poses over the whole ranges of the joints, (joints,) each, in rad."""
    low, high = find_sampling_range(cell)
    edge = 0.1 * (high - low)
    drawn = np.random.default_rng(0).uniform(low + edge, high - edge, (POSE_COUNT, len(low)))
    return list(drawn)


def find_touching_bodies(
    cell: Cell, data: mujoco.MjData, q: Array, skin_m: float = CONTACT_DISTANCE_M
) -> set[tuple[str, str]]:
    """Find pairs of bodies in unintended contact at a pose.

    Args:
        cell: The arm and its surroundings.
        data: Simulation data of the cell, which this function sets to the pose.
        q: Positions of the joints, (joints,), in rad.
        skin_m: Distance in m below which bodies count as touching. The margin of each geom
            must be at least half of it.

    Returns:
        Names of the bodies, sorted within each pair.
    """
    model = cell.model
    data.qpos[cell.qpos] = q
    mujoco.mj_fwdPosition(model, data)
    bodies = model.geom_bodyid[find_unintended_contacts(data, cell.geoms.touch, skin_m)]
    names = [sorted(str(model.body(body).name) for body in pair) for pair in bodies]
    return {(first, second) for first, second in names}


def _compute_limits(draft: Draft) -> JointLimits:
    """Compute the limits that the model does not state, and the bandwidth of the joint loop.

    Guessed torques suffice for weight, friction and inertia. Guessed velocities and all
    accelerations are limited to what the torques permit. A bandwidth above the default is chosen if
    dry friction needs it.
    """
    stated = draft.limits
    cell = draft.build_cell()
    dynamics = Dynamics(cell)
    velocity = np.array(stated.velocity)
    weight, drag, inertia = np.zeros((3, len(velocity)))
    least_inertia = np.full(len(velocity), np.inf)
    for q in sample_poses(cell):
        # Copy, because `terms` returns views of one array.
        bias, still = (dynamics.terms(q, v).bias.copy() for v in (velocity, 0.0 * velocity))
        weight = np.maximum(weight, np.abs(still))
        drag = np.maximum(drag, np.abs(bias - still))
        joint_inertia = np.diag(dynamics.terms(q, velocity).inertia)
        inertia = np.maximum(inertia, joint_inertia)
        least_inertia = np.minimum(least_inertia, joint_inertia)
    weight = weight + np.abs(dynamics.friction(velocity))
    wanted = velocity / SPEED_UP_S
    needed_torque = TORQUE_MARGIN * (weight + drag + inertia * wanted)
    torque = np.where(stated.is_torque_stated, stated.torque, needed_torque)
    spare_torque = torque - weight
    scale = np.clip(
        MAX_DRAG_FRACTION * spare_torque / np.maximum(drag, 1e-9), MIN_SPARE_TORQUE, 1.0
    )
    scale[[joint not in stated.unstated for joint in draft.arm.joints]] = 1.0
    acceleration = np.clip(0.5 * (spare_torque - scale * drag) / inertia, 0.1 * wanted, wanted)
    friction_acceleration = float(np.max(dynamics.dry / least_inertia))  # rad/s2
    needed = min(np.sqrt(friction_acceleration / MAX_REST_ERROR_RAD), MAX_BANDWIDTH)
    default = LoopGains().bandwidth
    return replace(
        stated,
        velocity=_round_values(scale * velocity),
        acceleration=_round_values(acceleration),
        jerk=_round_values(10.0 * acceleration),
        torque=_round_values(torque),
        bandwidth=round(float(needed), 1) if needed > default else None,
        friction_error=friction_acceleration / default**2,
    )


def _round_values(values: Array) -> list[float]:
    """Round values to three significant digits."""
    return [float(f"{value:.3g}") for value in values]


def find_home(
    draft: Draft, scene: SceneConfig = EMPTY_SCENE, ends: Sequence[Array] = ()
) -> HomePose:
    """Find a home pose in which the arm touches nothing and can hold its weight.

    A keyframe that qualifies is preferred. Otherwise the best of the sampled poses is chosen.

    Args:
        draft: The arm. Its `home` is not used.
        scene: Objects and supports beside the arm.
        ends: Final positions of the objects, (3,) each, in m. The pose must be free of contact also
            after the objects have been moved there.

    Raises:
        RobotError: No sampled pose qualifies, or the keyframe that the user named is unknown.
    """
    wanted = draft.options.home
    keyframes = draft.keyframes
    cell = draft.build_cell(scene)
    data = cell.build_start_data()
    checker = CollisionChecker(cell, scene)
    later = CollisionChecker(cell, scene)
    if ends:
        later.place_bodies(np.array(ends), data.xquat[cell.bodies])
    statics = Statics(cell)
    low, high = cell.limits.position.T

    def compute_spare_torque(q: Array) -> float:
        """Return the smallest torque reserve of a joint at rest, minus the required reserve.

        Reserves are fractions of the joints' torque limits.

        Returns -1 for a pose out of range or in contact.
        """
        is_within = np.all(q >= low) and np.all(q <= high)
        if is_within and checker.is_free(q, 0.0) and (not ends or later.is_free(q)):
            return float(statics.compute_load_limits(q)[0].min()) - MIN_SPARE_TORQUE
        return -1.0

    if wanted and wanted not in keyframes:
        try:
            return HomePose([float(value) for value in wanted.split(",")])
        except ValueError:
            known = format_names(list(keyframes))
            raise RobotError(
                f"--home: '{wanted}' is not a keyframe; valid: {known}, or q1,q2,..."
            ) from None
    named = sorted(keyframes, key=lambda name: name != (wanted or "home"))
    for name in named:
        if compute_spare_torque(keyframes[name]) > 0:
            return HomePose(keyframes[name].round(5).tolist())
    set_margins(cell.model, 0.5 * PREFERRED_CLEARANCE_M)

    def rate_pose(q: Array) -> float:
        """Score a pose by spare torque, clearance, and how far downward the tool points."""
        # Forward kinematics at `q` is a side effect of `find_touching_bodies`.
        is_near = bool(find_touching_bodies(cell, data, q, PREFERRED_CLEARANCE_M))
        downward = -float(data.site_xmat[cell.tool, 8])
        return compute_spare_torque(q) + downward - 2.0 * is_near

    usable_poses = (q for q in sample_poses(cell) if compute_spare_torque(q) > 0)
    best = max(usable_poses, key=rate_pose, default=None)
    if best is None:
        raise RobotError(
            "no pose was found that is free of contact and held by the motors; give one with --home"
        )
    return HomePose(best.round(4).tolist(), "free of contact, the tool as far down as found")
