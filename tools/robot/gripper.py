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
from rack.levels.robot.model import JOINT_DRIVES, add_motor, remove, stated_torque
from rack.levels.tables import GripperConfig, ToolConfig
from rack.tools.robot.arm import ArmParts

MOTOR = "gripper"
"""Name of the motor of a gripper that has none."""
FORCE_N = 20.0
"""Of a gripper whose model says nothing, at its fingers."""
STIFFNESS = 2000.0
DAMPING = 60.0
"""Of the position loop at the fingers, N/m and N s/m; a rotary joint has a lever."""
DRIVE_KG = 0.1
"""Drive inertia at the fingers, at least: the loop is closed once in a servo cycle."""
LEAST_LEVER_M = 0.02
STEP_M = 0.0025
"""Spacing of the places between the fingers that are tried."""
FROM_TIP_M = 0.012
"""Depth of the tool's origin between the fingers."""
LEAST_GAP_M = 0.012
"""A gripper that opens less has no use for a block."""
NEARLY = 0.6
"""Part of the way to closed, near enough to tell where the fingers will meet."""
LEAST_WAY_M = 1e-4
ALIGNED = 0.98
"""Cosine above which a direction is that of the body's axis."""


class _Finger(NamedTuple):
    open: float
    closed: float
    lever: float  # m; 1 for a slide


def fit_fingers(
    spec: mujoco.MjSpec, model: mujoco.MjModel, arm: ArmParts, wanted: str
) -> tuple[GripperConfig, bool]:
    """Give the gripper one drive, at the joint `wanted` if that is named, and what nothing couples
    a coupling; return its table, and whether the force is known. Raises `RobotError`."""
    fingers = {name: _finger(model, arm, name) for name in arm.fingers}
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
    drives.sort(key=lambda drive: drive[1] != wanted)
    driven = drives[0][1] if drives else wanted or arm.fingers[0]
    own = fingers[driven]
    stated = stated_torque(spec, driven, [actuator for actuator, _ in drives])
    force = stated or FORCE_N * own.lever
    remove(spec, [actuator for actuator, _ in drives[1:]])
    if not drives:
        add_motor(spec, MOTOR, mujoco.mjtTrn.mjTRN_JOINT, driven, force)
    joint = spec.joint(driven)
    joint.armature = max(float(joint.armature), DRIVE_KG * own.lever**2)
    for name in set(fingers) - {driven} - _coupled(spec, model, arm):
        _couple(spec, model, (name, fingers[name]), (driven, own))
    config = GripperConfig(
        actuator=drives[0][0].name if drives else MOTOR,
        joint=driven,
        open=round(own.open, 5),
        closed=round(own.closed, 5),
        force=round(force, 3),
        stiffness=round(STIFFNESS * own.lever**2, 3),
        damping=round(DAMPING * own.lever**2, 4),
    )
    return config, stated > 0


def _finger(model: mujoco.MjModel, arm: ArmParts, name: str) -> _Finger:
    """Return the ends of a joint of the gripper: it closes where it moves to the middle of all
    fingers, or to the hand. Raises `RobotError`."""
    joint = model.joint(name).id
    low, high = model.jnt_range[joint]
    if not model.jnt_limited[joint]:
        raise RobotError(f"joint '{name}' of the gripper has no range")
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
    closes = float(jacobian[:, model.jnt_dofadr[joint]] @ (middle - centre)) > 0.0
    is_slide = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
    lever = 1.0 if is_slide else max(LEAST_LEVER_M, norm(centre - data.xanchor[joint]))
    return _Finger(*((low, high) if closes else (high, low)), lever)


def _above(model: mujoco.MjModel, body: int, hand: int) -> set[int]:
    """Return the bodies between one and the hand."""
    found = set()
    while (body := int(model.body_parentid[body])) not in (0, hand):
        found.add(body)
    return found


def _centre(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Array:
    geoms = geoms_of(model, below(model, np.array([body])))
    return np.asarray(data.geom_xpos[geoms].mean(axis=0) if len(geoms) else data.xipos[body])


def _coupled(spec: mujoco.MjSpec, model: mujoco.MjModel, arm: ArmParts) -> set[str]:
    """Return the joints of the gripper that an equality or a spring determines."""
    named = {name for e in spec.equalities for name in (e.name1, e.name2)}
    for tendon in spec.tendons:
        named |= {w.target.name for w in tendon.path} if tendon.name in named else set()
    found = set()
    for name in arm.fingers:
        joint = model.joint(name).id
        beyond = np.flatnonzero(below(model, model.jnt_bodyid[[joint]]))
        loops = {model.body(body).name for body in beyond} & named
        if name in named or loops or model.jnt_stiffness[joint] > 0:
            found.add(name)
    return found


def _couple(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    follower: tuple[str, _Finger],
    leader: tuple[str, _Finger],
) -> None:
    """Let a joint close as the driven one does."""
    name, own = follower
    driven, lead = leader
    slope = (own.closed - own.open) / (lead.closed - lead.open)
    start, first = (model.qpos0[model.joint(j).qposadr[0]] for j in (name, driven))
    equality = spec.add_equality(name1=name, name2=driven)
    equality.type = mujoco.mjtEq.mjEQ_JOINT
    equality.objtype = mujoco.mjtObj.mjOBJ_JOINT
    equality.data[:2] = [own.open - start - slope * (lead.open - first), slope]
    equality.solref[:] = [0.002, 1.0]
    equality.solimp[:3] = [0.99, 0.999, 0.001]


class Fingertips(NamedTuple):
    """What two fingers can take."""

    tool: ToolConfig  # z out of the hand, y across
    opening: float  # m or rad: the widest at which they face each other
    width: float  # between them there, m
    below: float  # how far they reach beyond the tool, m


def find_fingertips(cell: Cell, tip: str) -> Fingertips | None:
    """Return what the gripper can take, by rays between its fingers; None: they do not close on
    each other, or not on anything."""
    model = cell.model
    data = cell.start()
    gripper = cell.gripper
    assert gripper is not None, "there are fingers"
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    geoms = cell.gripper_geoms[solid[cell.gripper_geoms]]
    pads = set(geoms.tolist())

    def closed_to(part: float) -> Array:
        gripper.linkage.set(data.qpos, gripper.open + part * (gripper.closed - gripper.open))
        mujoco.mj_forward(model, data)
        return np.array(data.geom_xpos[geoms])

    ends = closed_to(1.0)
    ways = closed_to(NEARLY) - ends
    moving = np.linalg.norm(ways, axis=1) > LEAST_WAY_M
    ways = ways[moving]
    if not moving.any() or (ways @ ways.T).min() >= 0.0:
        return None
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
        hit = np.full(1, -1, dtype=np.int32)
        for way in (across, -across):
            distance = mujoco.mj_ray(model, data, at, way, None, 1, -1, hit)
            found.append(distance if distance >= 0 and int(hit[0]) in pads else np.inf)
        return found[0], found[1]

    places = [middle + out * step * STEP_M for step in range(60, -40, -1)]
    between = [place for place in places if np.isfinite(gap(place)).all()]
    if not between:
        return None
    origin = between[min(int(FROM_TIP_M / STEP_M), len(between) // 2)]
    left, right = gap(origin)
    origin = origin + 0.5 * (left - right) * across
    for part in np.linspace(0.0, NEARLY, 8):
        closed_to(part)
        width = sum(gap(origin))
        if np.isfinite(width):
            break
    if not LEAST_GAP_M < width < np.inf:
        return None
    below = max(_extent(model, data, int(geom), out) for geom in geoms) - float(origin @ out)
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
