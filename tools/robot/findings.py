"""Examines an arm before it moves: its joints, its abilities, and what is wrong with it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from rack.levels.errors import RobotError
from rack.levels.planning.payload import Payloads, find_fixed_jaw
from rack.levels.robot.abilities import Abilities, Statics, compute_abilities
from rack.levels.robot.cell import Cell, build_unchecked_cell, check_fingers
from rack.levels.robot.model import load_spec
from rack.levels.tables import GripperConfig, RobotConfig, SceneConfig
from rack.levels.task.program import DOWN
from rack.tools.console.answer import Document
from rack.tools.robot.draft import find_touching_bodies

MAX_PHASE_RAD = 0.5
"""Largest phase angle of a vibration in one step, in rad, for a trustworthy simulation."""


@dataclass(frozen=True)
class Observation:
    """Result of one check, which may be a failure."""

    about: str
    text: str
    fails: bool


@dataclass(frozen=True)
class ArmExamination:
    """An arm with the results of its examination."""

    cell: Cell
    joints: list[Document]
    abilities: Abilities
    findings: list[Observation]


def examine_arm(robot: RobotConfig, scene: SceneConfig, clock_ns: int) -> ArmExamination:
    """Examine an arm in its cell. Contacts at home are reported as findings, not as errors.

    Args:
        robot: Table of the arm.
        scene: Objects and supports around it.
        clock_ns: Clock period.

    Raises:
        RobotError: The cell cannot be built.
    """
    cell = build_unchecked_cell(robot, scene, clock_ns)
    able = compute_abilities(cell)
    findings = list(_check_arm(cell, robot, scene, able))
    return ArmExamination(cell, list(_list_joints(cell, robot)), able, findings)


def _list_joints(cell: Cell, robot: RobotConfig) -> Iterator[Document]:
    """Yield axis, limits, home position and gravity load of each joint."""
    data = cell.build_start_data()
    left, _ = Statics(cell).compute_load_limits(cell.home)
    for k, name in enumerate(robot.joints):
        joint = cell.model.dof_jntid[cell.dof[k]]
        yield {
            "joint": name,
            "axis": (data.xaxis[joint] + 0.0).round(2).tolist(),
            "low": round(float(cell.bounds.position[k, 0]), 3),
            "high": round(float(cell.bounds.position[k, 1]), 3),
            "velocity": float(cell.bounds.velocity[k]),
            "torque": float(cell.bounds.torque[k]),
            "home": float(cell.home[k]),
            "gravity_part": round(1.0 - float(left[k]), 2),
        }


def _check_arm(
    cell: Cell, robot: RobotConfig, scene: SceneConfig, abilities: Abilities
) -> Iterator[Observation]:
    """Check the arm, its gripper and its objects, and yield one result per check."""
    model = cell.model
    data = cell.build_start_data()
    low, high = cell.limits.position.T
    outside = [
        n for n, q, a, b in zip(robot.joints, cell.home, low, high, strict=True) if not a <= q <= b
    ]
    yield Observation(
        "home", f"outside its limits: {', '.join(outside) or 'no joint'}", bool(outside)
    )
    is_too_weak = abilities.torque_left < 0.0
    weakest_joint = robot.joints[abilities.joint]
    load_percent = 100 * (1 - abilities.torque_left)
    weight_text = f"gravity takes {load_percent:.0f} % of '{weakest_joint}' at worst"
    yield Observation("weight", weight_text, is_too_weak)
    pairs = sorted(" and ".join(pair) for pair in find_touching_bodies(cell, data, cell.home))
    yield Observation("contacts at home", ", ".join(pairs) or "none", bool(pairs))
    known_addresses = {*cell.qpos, *cell.object_qpos, *model.jnt_qposadr[model.jnt_stiffness > 0.0]}
    if cell.gripper is not None:
        known_addresses |= {cell.gripper.linkage.driven, *cell.gripper.linkage.joints}
    loose_bodies = {
        int(model.jnt_bodyid[k])
        for k in range(model.njnt)
        if model.jnt_qposadr[k] not in known_addresses
    }
    names = sorted(model.body(body).name for body in loose_bodies)
    yield Observation("unattached bodies", ", ".join(names) or "none", bool(names))
    kinds = Counter(map(_actuator_kind, load_spec(robot.model).actuators))
    yield Observation(
        "actuators", ", ".join(f"{n} {kind}" for kind, n in kinds.items()) or "none", False
    )
    if robot.gripper is not None:
        coupling_error = _find_coupling_error(cell, robot.gripper)
        yield Observation(
            "coupling",
            coupling_error or "fingers settle where planning poses them",
            bool(coupling_error),
        )
        yield Observation("fingers", _describe_fingers(cell, scene), False)
    phase, spring = _find_fastest_vibration(cell)
    needed_substeps = int(np.ceil(robot.substeps * phase / MAX_PHASE_RAD)) or 1
    text = f"{spring:.3g} Hz at most; {needed_substeps} of {robot.substeps} substeps are enough"
    yield Observation("natural frequency", text, needed_substeps > robot.substeps)
    hit_geom = np.full(1, -1, dtype=np.int32)
    for body in cell.bodies[: len(cell.object_qpos)]:
        mujoco.mj_ray(model, data, data.xpos[body], np.array(DOWN), None, 1, int(body), hit_geom)
        if hit_geom[0] < 0:
            yield Observation("objects", f"'{model.body(body).name}' falls without end", True)
    if robot.guessed:
        yield Observation("guessed", ", ".join(robot.guessed), False)


def _actuator_kind(actuator: mujoco.MjsActuator) -> str:
    """Return the kind of an actuator: motor, position or velocity."""
    if actuator.biastype == mujoco.mjtBias.mjBIAS_NONE:
        return "motor"
    return "position" if actuator.biasprm[1] else "velocity"


def _describe_fingers(cell: Cell, scene: SceneConfig) -> str:
    """Describe which fingers close at the tool, and how far they open."""
    payloads = Payloads(cell, scene.objects)
    if not payloads.jaws:
        return "none on both sides of the tool, along its y axis"
    sides = "fingers on both sides"
    if find_fixed_jaw(cell, payloads) is not None:
        sides = "one finger, which closes on a fixed jaw"
    return f"{sides}; {1e3 * payloads.jaws[0].gap:.0f} mm open at the tool"


def _find_coupling_error(cell: Cell, config: GripperConfig) -> str:
    """Return the reason why the fingers do not settle at the positions that planning assumes.

    Empty if they do.
    """
    try:
        check_fingers(cell, config)
    except RobotError as error:
        return str(error)
    return ""


def _find_fastest_vibration(cell: Cell) -> tuple[float, float]:
    """Find the fastest natural vibration of the joints with their springs and gripper control.

    Returns:
        Phase advance of the vibration per simulation step in rad, and its frequency in Hz.
    """
    model = cell.model
    data = cell.build_start_data()
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    stiffness = model.jnt_stiffness[model.dof_jntid].copy()
    if cell.gripper is not None:
        stiffness[cell.gripper.dof] += cell.gripper.stiffness
    squared_frequency = np.linalg.eigvals(np.linalg.solve(inertia, np.diag(stiffness))).real.max(
        initial=0.0
    )
    angular_frequency = float(np.sqrt(max(squared_frequency, 0.0)))
    return angular_frequency * model.opt.timestep, angular_frequency / (2.0 * np.pi)
