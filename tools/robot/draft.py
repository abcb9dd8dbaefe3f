"""From a model to a `[robot]` table: what the model states is taken, the rest found or guessed, and
each guess named.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from pydantic import ValidationError

from rack.levels.algebra import Array
from rack.levels.errors import RobotError
from rack.levels.planning.collision import CollisionChecker
from rack.levels.planning.ik import sampling_range
from rack.levels.robot.abilities import Statics
from rack.levels.robot.cell import (
    Cell,
    build_cell,
    check_fingers,
    unchecked_cell,
    unintended_contacts,
)
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.engine import set_margins
from rack.levels.robot.linkage import check_couplings
from rack.levels.robot.model import compile_spec, listed, load_spec, stated_torque
from rack.levels.servo.control import LoopGains
from rack.levels.tables import RobotConfig, SceneConfig
from rack.tools.robot.arm import ArmParts, driven_joints, find_arm, hold
from rack.tools.robot.fingertips import Fingertips, find_fingertips, tool_outward
from rack.tools.robot.gripper import fit_fingers
from rack.tools.robot.pieces import cut_meshes
from rack.tools.robot.source import Source, copy_model

CLOCK_NS = 2_500_000
"""Of `nasrem`, whose levels and boards the arm gets."""
SPEED = {mujoco.mjtJoint.mjJNT_HINGE: 1.5, mujoco.mjtJoint.mjJNT_SLIDE: 0.25}
"""Guesses, rad/s and m/s."""
SPEED_UP_S = 0.5
"""Time to full speed of planned motion, where the motors can; jerk follows, ten times in a
second."""
LEAST_PART = 0.2
"""Part of each torque that gravity must leave at home."""
ROOM = 2.0
"""A guessed torque in the weights and inertia that it moves."""
DRAG_PART = 0.4
"""Of the torque that gravity leaves, for friction at a guessed velocity."""
REST_RAD = 0.002
"""Where dry friction may hold a joint at rest, from where it should be; tasks permit 0.003."""
MOST_BANDWIDTH = 100.0
"""Of the joint loop, rad/s."""
POSES = 400
SKIN_M = 1e-4
"""What is closer counts as in contact: planning would find no way there."""
APART_M = 0.005
"""Home is rather where nothing is closer: a linkage settles a little off its equalities."""
ALWAYS = 0.95
"""Bodies in contact in so many poses are neighbours, whose shapes overlap."""
TOOLS = ("tcp", "tool", "grip_site", "attachment", "eef", "ee_", "pinch", "hand", "flange")
"""Parts of the names of frames at the end of an arm, the best first."""
NOTHING = SceneConfig()


@dataclass(frozen=True)
class Wishes:
    """What the user says of an arm; empty: find it."""

    tip: str = ""
    joints: tuple[str, ...] = ()
    tool: str = ""
    gripper: str = ""
    home: str = ""
    torque: tuple[float, ...] = ()


@dataclass
class Draft:
    """An arm as far as it is known."""

    model: Path  # of its own
    spec: mujoco.MjSpec  # the same, or what it is to be
    wanted: Wishes
    arm: ArmParts
    starts: Mapping[str, Array]  # positions of the arm's joints, by the names of keyframes
    guessed: dict[str, str] = field(default_factory=dict)  # by key, what was guessed
    notes: list[str] = field(default_factory=list)
    table: dict[str, Any] = field(default_factory=dict)
    jaws: Fingertips | None = None  # None: nothing can be taken
    bandwidth: float | None = None  # of the joint loop, rad/s; None: that of `nasrem`

    @property
    def robot(self) -> RobotConfig:
        """The table as it is now. Raises `RobotError`."""
        try:
            return RobotConfig(**self.table, guessed=tuple(self.guessed))
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(map(str, first["loc"]))
            raise RobotError(f"robot.{key} = {first['input']}: {first['msg'].lower()}") from None

    def cell(self, scene: SceneConfig = NOTHING) -> Cell:
        """Return the cell as it is now. Raises `RobotError`."""
        return unchecked_cell(self.robot, scene, CLOCK_NS)

    def write_model(self) -> None:
        """Write the model. Raises `RobotError`."""
        compile_spec(self.spec, self.model)
        self.model.write_text(self.spec.to_xml(), encoding="utf-8")

    def hold(self, joints: Sequence[str]) -> list[str]:
        """Hold all joints but these; return the bodies that are left out, since they fly."""
        left = hold(self.model, joints)
        self.spec = load_spec(self.model)
        return left

    def search_home(self, scene: SceneConfig = NOTHING, ends: Sequence[Array] = ()) -> None:
        """Set home to a pose in which the arm carries itself, free before and after the objects of
        the scene are at their `ends`, m. Raises `RobotError`.
        """
        cell = self.cell(scene)
        data = cell.start()
        checkers = [CollisionChecker(cell, scene)]
        if ends:
            checkers.append(CollisionChecker(cell, scene))
            checkers[1].place(np.array(ends), data.xquat[cell.bodies])
        self.table["home"], guess = _home(cell, checkers, self.starts, self.wanted.home)
        self.guessed.pop("home", None)
        if guess:
            self.guessed["home"] = guess


def draft(source: Source, wanted: Wishes, folder: Path, name: str) -> Draft:
    """Return the arm of a model, as `rack run` takes it: a gripper that it would refuse is held.
    Raises `RobotError`, one line.
    """
    try:
        made = _draft(source, wanted, folder, name)
    except RobotError as error:
        raise RobotError("; ".join([str(error), *source.notes])) from None
    try:
        build_cell(made.robot, NOTHING, CLOCK_NS)
    except RobotError as error:
        if made.jaws is None:
            raise
        made = _draft(source, replace(wanted, gripper="none"), folder, name)
        made.notes.append(f"no gripper: {error}")
    return made


def _draft(source: Source, wanted: Wishes, folder: Path, name: str) -> Draft:
    model = source.compiled()
    arm = find_arm(model, wanted.tip, wanted.joints)
    # Equalities with joints that are held are gone afterwards.
    check_couplings(model, arm.joints, of_bodies=False)
    addresses = [model.joint(joint).qposadr[0] for joint in arm.joints]
    starts = {
        model.key(k).name or f"key {k}": model.key_qpos[k][addresses] for k in range(model.nkey)
    }
    fingers = () if wanted.gripper == "none" else arm.fingers
    path = folder / f"{name}.xml"
    made = Draft(path, source.spec, wanted, arm, starts, notes=list(source.notes))
    copy_model(source, path)
    springs = [joint for joint in arm.passive if model.joint(joint).stiffness > 0.0]
    if left := made.hold((*arm.joints, *fingers, *springs)):
        made.notes.append(f"left out, as nothing holds it: {listed(left)}")
    if endless := [joint for joint in arm.joints if not model.joint(joint).limited]:
        made.notes.append(f"without limits: {listed(endless)}; [robot] position can state them")
    if arm.passive:
        why = "nothing drives them: --joints would; those without a spring are held"
        made.notes.append(f"passive, beyond the arm: {listed([*arm.passive])}; {why}")
    if arm.others:
        others = listed(list(arm.others))
        made.notes.append(f"held: what begins at {others}; --tip chooses another arm")
    spec = made.spec
    kinds = [spec.joint(joint).type for joint in arm.joints]
    known = source.velocity
    velocity = [known.get(j, SPEED[kind]) for j, kind in zip(arm.joints, kinds, strict=True)]
    missing = [joint for joint in arm.joints if joint not in known]
    if missing:
        made.guessed["velocity"] = f"the model states none for {listed(missing)}"
    stated = [stated_torque(spec, joint, spec.actuators) for joint in arm.joints]
    ids = {model.joint(joint).id for joint in arm.joints}
    if not (wanted.torque or driven_joints(model) & ids):
        why = "no actuator and no effort"
        raise RobotError(f"{why} at {listed(list(arm.joints))}; --torque T,... states the limits")
    made.table = {
        "model": path,
        "joints": arm.joints,
        "tool": _mount(compile_spec(spec, path), arm.tip, wanted.tool),
        "home": [0.0] * len(arm.joints),
        "velocity": velocity,
        "acceleration": velocity,
        "jerk": velocity,
        "torque": list(wanted.torque or (limit or 1e6 for limit in stated)),
    }
    if fingers:
        _add_gripper(made)
    _exclude(made)
    if not wanted.tool and made.jaws is None:
        tool, offset = tool_outward(made.cell(), made.table["tool"])
        made.table |= {"tool": tool, "tool_offset": offset}
        made.guessed["tool"] = "z along the last joint, outward"
    unknown = [not limit for limit in wanted.torque or stated]
    _dimension(made, unknown, [joint in missing for joint in arm.joints])
    made.search_home()
    return made


def _mount(model: mujoco.MjModel, tip: str, wanted: str) -> str:
    """Return the body or site that ends an arm."""
    if wanted:
        return wanted
    carried = [model.body(tip).id]
    for body in range(carried[0] + 1, model.nbody):
        if model.body_parentid[body] in carried and not model.body_jntnum[body]:
            carried.append(body)
    names = [model.body(body).name for body in carried]
    named = [name for part in TOOLS for name in names[1:] if part in name.lower()]
    return str((named or names[-1:])[0])


def _add_gripper(made: Draft) -> None:
    """Add the gripper that the arm carries, if it can be used, and the tool between its fingers."""
    wanted = made.wanted.gripper
    arm = made.arm
    if wanted and wanted not in arm.fingers:
        raise RobotError(
            f"--gripper: no joint '{wanted}' beyond the arm; {listed(list(arm.fingers))}, none"
        )
    try:
        config, guess = fit_fingers(made.spec, compile_spec(made.spec, made.model), arm, wanted)
        made.table["gripper"] = config
        made.write_model()
        cell = made.cell()
        jaws = find_fingertips(cell, arm.tip)
        if jaws.is_one:
            pieces = cut_meshes(made.spec, cell, jaws.out)
            why = f"; their meshes are cut to {pieces} convex pieces" if pieces else ""
            made.notes.append(f"one finger closes on a fixed jaw{why}")
            made.write_model()
            jaws = find_fingertips(made.cell(), arm.tip, is_one=True)
        config = config.model_copy(update={"open": round(jaws.opening, 5)})
        made.table["gripper"] = config
        cell = made.cell()
        # Where home is, is not known yet: the fingers settle as if they were alone.
        alone = np.isin(np.arange(cell.model.ngeom), cell.geoms.gripper)
        cell.model.geom_contype *= alone
        cell.model.geom_conaffinity *= alone
        check_fingers(cell, config)
    except RobotError as error:
        made.notes.append(f"no gripper: {error}")
        made.table.pop("gripper", None)
        made.write_model()
        made.hold(arm.joints)
        return
    if guess:
        made.guessed["gripper"] = guess
    made.jaws = jaws
    if not made.wanted.tool:
        made.table |= {"tool": arm.tip, "tool_offset": jaws.tool}
        sides = "finger and fixed jaw" if jaws.is_one else "the fingers"
        made.guessed["tool"] = f"between {sides}, z out of the hand, y across"


def _exclude(made: Draft) -> None:
    """Exclude contacts of bodies whose shapes always overlap."""
    cell = made.cell()
    set_margins(cell.model, SKIN_M)
    data = cell.start()
    count: Counter[tuple[str, str]] = Counter()
    for q in poses(cell):
        count.update(touching(cell, data, q))
    pairs = tuple(sorted(pair for pair, n in count.items() if n >= ALWAYS * POSES))
    if pairs:
        made.table["exclude"] = pairs
        made.guessed["exclude"] = "these bodies overlap in every pose"


def poses(cell: Cell) -> list[Array]:
    """Return poses all over the joints' ranges, (joints,), rad."""
    low, high = sampling_range(cell)
    edge = 0.1 * (high - low)
    drawn = np.random.default_rng(0).uniform(low + edge, high - edge, (POSES, len(low)))
    return list(drawn)


def touching(
    cell: Cell, data: mujoco.MjData, q: Array, skin_m: float = SKIN_M
) -> set[tuple[str, str]]:
    """Return the pairs of bodies in unintended contact at `q`, or closer than `skin_m`, if geoms
    have that margin.
    """
    model = cell.model
    data.qpos[cell.qpos] = q
    mujoco.mj_fwdPosition(model, data)
    bodies = model.geom_bodyid[unintended_contacts(data, cell.geoms.touch, skin_m)]
    names = [sorted(str(model.body(body).name) for body in pair) for pair in bodies]
    return {(first, second) for first, second in names}


def _dimension(made: Draft, unknown: list[bool], guessed: list[bool]) -> None:
    """Set the torques that are unknown, the velocities that are guessed, accelerations that the
    motors can give, and a loop that is stiff against dry friction.
    """
    cell = made.cell()
    dynamics = Dynamics(cell)
    velocity = np.array(made.table["velocity"])
    weight, drag, inertia = np.zeros((3, len(velocity)))
    least = np.full(len(velocity), np.inf)
    for q in poses(cell):
        # The terms are views of one array.
        bias, still = (dynamics.terms(q, v).bias.copy() for v in (velocity, 0.0 * velocity))
        weight = np.maximum(weight, np.abs(still))
        drag = np.maximum(drag, np.abs(bias - still))
        own = np.diag(dynamics.terms(q, velocity).inertia)
        inertia = np.maximum(inertia, own)
        least = np.minimum(least, own)
    weight = weight + np.abs(dynamics.friction(velocity))
    wanted = velocity / SPEED_UP_S
    torque = np.array(made.table["torque"])
    torque = np.where(unknown, ROOM * (weight + drag + inertia * wanted), torque)
    if any(unknown):
        made.guessed["torque"] = f"{ROOM:g} times what weight, friction and inertia take"
    room = torque - weight
    slower = np.clip(DRAG_PART * room / np.maximum(drag, 1e-9), LEAST_PART, 1.0)
    slower = np.where(guessed, slower, 1.0)
    drag = slower * drag
    made.table["velocity"] = _rounded(slower * velocity)
    acceleration = np.clip(0.5 * (room - drag) / inertia, 0.1 * wanted, wanted)
    made.guessed["acceleration"] = made.guessed["jerk"] = "by the torques"
    made.table["torque"] = _rounded(torque)
    made.table["acceleration"] = _rounded(acceleration)
    made.table["jerk"] = _rounded(10.0 * acceleration)
    held = float(np.max(dynamics.dry / least))  # rad/s2
    needed = min(np.sqrt(held / REST_RAD), MOST_BANDWIDTH)
    if needed > (usual := LoopGains().bandwidth):
        made.bandwidth = round(float(needed), 1)
        away = f"{1e3 * held / usual**2:.1f} mrad"
        made.notes.append(
            f"a joint loop of {made.bandwidth:g} rad/s: at {usual:g} dry friction may hold a joint"
            f" {away} from its goal"
        )


def _rounded(values: Array) -> list[float]:
    return [float(f"{value:.3g}") for value in values]


def _home(
    cell: Cell, checkers: Sequence[CollisionChecker], starts: Mapping[str, Array], wanted: str
) -> tuple[list[float], str]:
    """Return home, and why if it is a guess: a keyframe that serves, or the best pose that does.
    Raises `RobotError`.
    """
    first, *later = checkers
    statics = Statics(cell)
    low, high = cell.limits.position.T

    def left(q: Array) -> float:
        """Return the part of the torques that gravity leaves; negative: the pose does not serve."""
        is_within = np.all(q >= low) and np.all(q <= high)
        if is_within and first.free(q, 0.0) and all(checker.free(q) for checker in later):
            return float(statics.held(q)[0].min()) - LEAST_PART
        return -1.0

    if wanted and wanted not in starts:
        try:
            return [float(value) for value in wanted.split(",")], ""
        except ValueError:
            known = listed(list(starts))
            raise RobotError(
                f"--home: '{wanted}' is no keyframe: {known}; valid, too: q1,q2,..."
            ) from None
    named = sorted(starts, key=lambda name: name != (wanted or "home"))
    for name in named:
        if left(starts[name]) > 0:
            return starts[name].round(5).tolist(), ""
    data = cell.start()
    set_margins(cell.model, 0.5 * APART_M)

    def rating(q: Array) -> float:
        is_near = bool(touching(cell, data, q, APART_M))
        return left(q) + _downward(first, cell, q) - 2.0 * is_near

    found = [(rating(q), q) for q in poses(cell) if left(q) > 0]
    if not found:
        raise RobotError(
            "no pose is free of contact and carries itself; --home q1,q2,... states one"
        )
    best = max(found, key=lambda pair: pair[0])[1]
    return best.round(4).tolist(), "free of contact, the tool as far down as found"


def _downward(checker: CollisionChecker, cell: Cell, q: Array) -> float:
    """Return how far the tool points down, -1 to 1."""
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, checker.tool_at(q).quaternion)
    return -float(turned[8])
