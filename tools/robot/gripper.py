"""The gripper that an arm carries: one joint drives it, the others follow; the tool between its
fingers."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from rack.levels.algebra import Array, norm
from rack.levels.errors import RobotError
from rack.levels.robot.cell import Cell
from rack.levels.robot.lookup import below, geoms_of
from rack.levels.robot.model import JOINT_DRIVES, add_motor, listed, remove, stated_torque
from rack.levels.tables import FollowConfig, GripperConfig, ToolConfig
from rack.tools.robot.arm import ArmParts

MOTOR = "gripper"
"""Name of the motor of a gripper that has none."""
FORCE_N = 20.0
"""Of a gripper whose model says nothing, at its fingers."""
MOST_FORCE_N = 40.0
"""At the fingers; of more, which pushes a light block out, no use is made."""
LEAST_LEVER_M = 0.02
SIDEWAYS = 0.5
"""Cosine between a finger's motion and the way to the others below which it does not close."""
ROUNDING = 1e-9
"""In the Jacobian of an equality."""
STEP_M = 0.0025
"""Spacing of the places between the fingers that are tried."""
FROM_TIP_M = 0.012
"""Depth of the tool's origin between the fingers."""
LEAST_GAP_M = 0.012
"""A gripper that opens less has no use for a block."""
NEARLY = 0.6
"""Part of the way to closed, near enough to tell where the fingers will meet."""
LEAST_WAY_M = 1e-4
SEEN = np.array([0, 1, 0, 0, 0, 0], dtype=np.uint8)
"""Groups of geoms, for rays: the second."""
ASIDE_M = (0.0, 0.01, -0.01, 0.02, -0.02)
"""Where a ray between the fingers starts, besides the middle: the two of three leave a gap."""
ALIGNED = 0.98
"""Cosine above which a direction is that of the body's axis."""


class _Finger(NamedTuple):
    open: float
    closed: float
    lever: float  # m; 1 for a slide
    sideways: bool  # spreads the fingers, rather than closes them


def fit_fingers(
    spec: mujoco.MjSpec, model: mujoco.MjModel, arm: ArmParts, wanted: str
) -> tuple[GripperConfig, str]:
    """Give the gripper one drive, at the joint `wanted` if that is named, which all that nothing
    couples to it follows; return its table, and what of it is guessed. Raises `RobotError`."""
    fingers = {name: _finger(spec, model, arm, name) for name in arm.fingers}
    tendons = {
        tendon.name: [wrap.target.name for wrap in tendon.path if wrap.target.name in fingers]
        for tendon in spec.tendons
    }
    drives = [
        (actuator, found[0])
        for actuator in spec.actuators
        if (
            found := [actuator.target]
            if actuator.trntype in JOINT_DRIVES and actuator.target in fingers
            else tendons.get(actuator.target, [])
        )
    ]
    drives.sort(key=lambda drive: (drive[1] != wanted, fingers[drive[1]].sideways))
    driven = drives[0][1] if drives else wanted or arm.fingers[0]
    own = fingers[driven]
    first = [joint for _, joint in drives] + list(arm.fingers)
    groups = [group for group in _groups(model, arm) if driven not in group]
    leaders = [min(group, key=first.index) for group in groups]
    follow = tuple(
        FollowConfig(joint=name, ratio=_ratio(model, (driven, own), (name, fingers[name])))
        for name in leaders
        if name in first[: len(drives)] or not model.jnt_stiffness[model.joint(name).id]
    )
    # One drive gives what all those gave that it stands for.
    moving = [driven, *(one.joint for one in follow if one.ratio)]
    actuators = [actuator for actuator, _ in drives]
    stated = [stated_torque(spec, name, actuators) for name in moving]
    levers = [fingers[name].lever for name in moving]
    used = [
        min(known or FORCE_N * lever, MOST_FORCE_N * lever)
        for known, lever in zip(stated, levers, strict=True)
    ]
    force = sum(used)
    remove(spec, actuators[1:])
    if drives:
        motor = actuators[0].name
    else:
        motor = MOTOR
        add_motor(spec, MOTOR, mujoco.mjtTrn.mjTRN_JOINT, driven, force)
    config = GripperConfig(
        actuator=motor,
        joint=driven,
        open=round(own.open, 5),
        closed=round(own.closed, 5),
        force=round(force, 3),
        follow=follow,
    )
    guesses = [] if used == stated else ["force"]
    guesses += [f"that {listed([one.joint for one in follow])} follow"] if follow else []
    return config, ", ".join(guesses)


def _finger(spec: mujoco.MjSpec, model: mujoco.MjModel, arm: ArmParts, name: str) -> _Finger:
    """Return the ends of a joint of the gripper: it closes where it moves to the middle of all
    fingers, or to the hand. Raises `RobotError`."""
    joint = model.joint(name).id
    low, high = model.jnt_range[joint]
    if not model.jnt_limited[joint]:
        raise RobotError(f"joint '{name}' of the gripper has no range")
    for actuator in spec.actuators:
        # The set points of a servo may leave a part of the range out.
        if actuator.target == name and actuator.biastype and np.ptp(actuator.ctrlrange) > 0.0:
            low, high = np.clip(actuator.ctrlrange, low, high)
    data = mujoco.MjData(model)
    ids = [model.joint(finger).id for finger in arm.fingers]
    data.qpos[model.jnt_qposadr[ids]] = model.jnt_range[ids].mean(axis=1)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    hand = model.body(arm.tip).id
    bodies = {int(model.jnt_bodyid[k]) for k in ids}
    tops = [body for body in bodies if not _above(model, body, hand) & bodies]
    centres = [_centre(model, data, body) for body in tops]
    middle = np.mean(centres, axis=0) if len(tops) > 1 else _centre(model, data, hand)
    moved = int(model.jnt_bodyid[joint])
    centre = _centre(model, data, moved)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, centre, moved)
    motion = jacobian[:, model.jnt_dofadr[joint]]
    inward = float(motion @ (middle - centre))
    is_slide = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
    lever = 1.0 if is_slide else max(LEAST_LEVER_M, norm(centre - data.xanchor[joint]))
    sideways = abs(inward) < SIDEWAYS * norm(motion) * norm(middle - centre)
    if inward > 0.0:
        return _Finger(low, high, lever, sideways)
    return _Finger(high, low, lever, sideways)


def _above(model: mujoco.MjModel, body: int, hand: int) -> set[int]:
    """Return the bodies between one and the hand."""
    found = set()
    while (body := int(model.body_parentid[body])) not in (0, hand):
        found.add(body)
    return found


def _centre(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Array:
    geoms = geoms_of(model, below(model, np.array([body])))
    if not len(geoms):
        return np.asarray(data.xipos[body])
    return np.asarray(data.geom_xpos[geoms].mean(axis=0))


def _groups(model: mujoco.MjModel, arm: ArmParts) -> list[set[str]]:
    """Return the joints of the gripper, those together that equalities tie to each other."""
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    rows = data.efc_J.reshape(-1, model.nv)[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]
    columns = {name: model.joint(name).dofadr[0] for name in arm.fingers}
    groups = [{name} for name in arm.fingers]
    for row in rows:
        tied = {name for name, column in columns.items() if abs(row[column]) > ROUNDING}
        together = [group for group in groups if group & tied]
        groups = [group for group in groups if not group & tied]
        if together:
            groups.append(set.union(*together))
    return groups


def _ratio(
    model: mujoco.MjModel, leader: tuple[str, _Finger], follower: tuple[str, _Finger]
) -> float:
    """Return the ratio by which a joint closes as the driven one does: as far, if it is of the
    same kind, else in its range; 0 if it does not close."""
    (driven, lead), (name, own) = leader, follower
    if own.sideways:
        return 0.0
    ratio = (own.closed - own.open) / (lead.closed - lead.open)
    is_same = model.joint(driven).type == model.joint(name).type
    return float(np.sign(ratio)) if is_same else round(ratio, 5)


class Fingertips(NamedTuple):
    """What two fingers can take."""

    tool: ToolConfig  # z out of the hand, y across
    opening: float  # m or rad: the widest at which they face each other
    width: float  # between them there, m
    below: float  # how far they reach beyond the tool, m


def find_fingertips(cell: Cell, tip: str) -> Fingertips:
    """Return what the gripper can take, by rays between its fingers. Raises `RobotError` where they
    do not close on each other, or not on a block."""
    model = cell.model
    data = cell.start()
    gripper = cell.gripper
    assert gripper is not None, "there are fingers"
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    geoms = cell.gripper_geoms[solid[cell.gripper_geoms]]
    # Of the gripper, rays see what is solid, of the rest nothing.
    model.geom_group[:] = 0
    model.geom_group[geoms] = 1

    def closed_to(part: float) -> Array:
        gripper.linkage.set(data.qpos, gripper.open + part * (gripper.closed - gripper.open))
        mujoco.mj_forward(model, data)
        return np.array(data.geom_xpos[geoms])

    closed = closed_to(1.0)
    ways = closed_to(NEARLY) - closed
    moving = np.linalg.norm(ways, axis=1) > LEAST_WAY_M
    ways = ways[moving]
    if not moving.any() or (ways @ ways.T).min() >= 0.0:
        raise RobotError("one finger, or fingers that do not close on each other")
    hand = model.body(tip).id
    axes = data.xmat[hand].reshape(3, 3).T
    across = np.linalg.svd(ways - ways.mean(axis=0))[2][0]
    side = ways @ across > 0
    half = closed_to(NEARLY)[moving]
    middle = 0.5 * (half[side].mean(axis=0) + half[~side].mean(axis=0))
    out = middle - data.xpos[hand]
    out = _snapped(out - across * (across @ out), axes)
    across = _snapped(across - out * (across @ out), axes)

    def gap(at: Array) -> tuple[float, float]:
        """Return the distances from a place to the fingers on both sides, m; inf: none."""
        found = []
        for way in (across, -across):
            starts = (at + aside * np.cross(across, out) for aside in ASIDE_M)
            rays = (mujoco.mj_ray(model, data, one, way, SEEN, 1, -1, None) for one in starts)
            found.append(next((d for d in rays if d >= 0), np.inf))
        return found[0], found[1]

    places = [middle + out * step * STEP_M for step in range(60, -40, -1)]
    between = [place for place in places if np.isfinite(gap(place)).all()]
    if not between:
        raise RobotError("fingers that close past each other")
    origin = between[min(int(FROM_TIP_M / STEP_M), len(between) // 2)]
    left, right = gap(origin)
    origin = origin + 0.5 * (left - right) * across
    for part in np.linspace(0.0, NEARLY, 8):
        closed_to(part)
        width = sum(gap(origin))
        if np.isfinite(width):
            break
    if not LEAST_GAP_M < width < np.inf:
        raise RobotError(
            f"fingers that open {1e3 * width:.0f} mm; {1e3 * LEAST_GAP_M:g} are needed"
        )
    # Fingers that turn reach farther as they close.
    ends = []
    for step in np.linspace(part, 1.0, 5):
        closed_to(step)
        ends += [_extent(model, data, int(geom), out) for geom in geoms]
    below = max(ends) - float(origin @ out)
    turned = np.stack((np.cross(across, out), across, out), axis=1)
    opening = gripper.open + float(part) * (gripper.closed - gripper.open)
    return Fingertips(_placed(data, hand, origin, turned), opening, width, below)


def _extent(model: mujoco.MjModel, data: mujoco.MjData, geom: int, way: Array) -> float:
    """Return how far a geom's bounding box reaches along a way, m."""
    turned = data.geom_xmat[geom].reshape(3, 3)
    centre = data.geom_xpos[geom] + turned @ model.geom_aabb[geom, :3]
    return float(way @ centre + np.abs(way @ turned) @ model.geom_aabb[geom, 3:])


def tool_outward(cell: Cell, body: str) -> tuple[str, ToolConfig | None]:
    """Return the tool of an arm that ends at a body, z along the last joint, outward: a site of the
    model, or a place on the body."""
    model = cell.model
    data = cell.start()
    at = data.xpos[model.body(body).id]
    axes = data.xmat[model.body(body).id].reshape(3, 3).T
    last, before = (int(model.dof_jntid[dof]) for dof in (cell.dof[-1], cell.dof[-2:][0]))
    out = data.xaxis[last]
    if out @ (at - data.xanchor[before]) < 0.0:
        out = -out
    out = _snapped(out, axes)
    carried = below(model, model.jnt_bodyid[[last]])[model.site_bodyid]
    carried[cell.tool] = False
    along = data.site_xmat[:, [2, 5, 8]] @ out > ALIGNED
    named = [model.site(site).name for site in np.flatnonzero(carried & along)]
    if sites := [str(name) for name in named if name]:
        return sites[-1], None
    side = axes[int(np.argmin(np.abs(axes @ out)))]
    side = side - out * (side @ out)
    side /= norm(side)
    turned = np.stack((np.cross(side, out), side, out), axis=1)
    return body, _placed(data, model.body(body).id, at, turned)


def _snapped(way: Array, axes: Array) -> Array:
    """Return a unit vector, that of an axis where it is about that."""
    way = way / norm(way)
    along = axes @ way
    best = int(np.argmax(np.abs(along)))
    return np.sign(along[best]) * axes[best] if abs(along[best]) > ALIGNED else way


def _placed(data: mujoco.MjData, body: int, origin: Array, turned: Array) -> ToolConfig:
    """Return a frame of the world, (3,) and (3, 3), as one on a body."""
    own = data.xmat[body].reshape(3, 3)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, (own.T @ turned).ravel())
    position = own.T @ (origin - data.xpos[body])
    x, y, z = position.round(5).tolist()
    a, b, c, d = quaternion.round(6).tolist()
    return ToolConfig(position=(x, y, z), quaternion=(a, b, c, d))
